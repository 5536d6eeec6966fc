"""Studies: many configurations over many seeds, shared out among processes and machines; and tuning."""
