"""Live mapping: the robot's loop in this process, the mapper in another."""
