"""A live session on an arm: the robot's loop, and the mapper in a process of its own."""
