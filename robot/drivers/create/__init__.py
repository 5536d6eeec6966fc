"""Driver of an iRobot Create on a serial line (Open Interface)."""
