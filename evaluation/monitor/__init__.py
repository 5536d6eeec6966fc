"""Progress of a running job, read from its run directory."""
