"""The interface between sessions and SLAM methods."""
