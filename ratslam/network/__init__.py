"""The pose cells: a network whose activity is the belief about the robot's pose."""
