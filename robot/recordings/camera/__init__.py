"""Cameras: grey frames to views and visual odometry, and video files."""
