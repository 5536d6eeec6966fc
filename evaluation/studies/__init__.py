"""Studies: many configurations over many seeds, shared out among processes; tuning; sizing."""
