"""ratslam: pose cells, view templates and an experience map, for touch."""

RATSLAM_PACKAGE = "ratslam"  # see tactile/__init__.py
