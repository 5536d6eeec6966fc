"""How good a map and a trajectory are, and how fast they were made."""

RATSLAM_PACKAGE = "evaluation"  # see tactile/__init__.py
