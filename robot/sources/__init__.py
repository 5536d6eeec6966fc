"""What a source of samples is, and sources held in memory."""
