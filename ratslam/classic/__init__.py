"""RatSLAM as published: view templates, places, experience map, relaxation."""
