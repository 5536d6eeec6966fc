"""A live view of a run in rerun, in a process of its own."""
