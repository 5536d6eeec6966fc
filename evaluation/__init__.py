"""Metrics, artifacts, plots and monitoring of SLAM runs."""

RATSLAM_PACKAGE = "evaluation"  # see tactile/__init__.py
