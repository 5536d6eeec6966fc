"""The results of a run as standard files."""
