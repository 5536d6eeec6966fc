"""Sources of readings: recordings, simulations and live robots."""

RATSLAM_PACKAGE = "robot"  # see tactile/__init__.py
