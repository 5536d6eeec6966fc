"""RatSLAM as published: pose cells, view templates, places, experience map, relaxation."""
