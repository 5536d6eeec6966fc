"""Contact detection, free-whisking calibration and whisker images."""
