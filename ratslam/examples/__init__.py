"""One short file for each way to extend ratslam, and one for one's own loop."""
