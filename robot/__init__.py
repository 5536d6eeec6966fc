"""Sources of whisk cycles and observations: recordings, simulators and live robots."""

RATSLAM_PACKAGE = "robot"  # see tactile/__init__.py
