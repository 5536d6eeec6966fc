"""The SLAM methods, one file each."""
