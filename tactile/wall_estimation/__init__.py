"""Walls from the strain of a Create's whiskers."""
