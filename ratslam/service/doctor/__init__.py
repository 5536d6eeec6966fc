"""Says what a recording, a run directory or a robot is, and what to do with it."""
