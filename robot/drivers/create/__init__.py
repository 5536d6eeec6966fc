"""An iRobot Create on its serial line: Open Interface, odometry, and what stops it."""
