"""Studies, the two papers' figures, and sizing; nothing else imports them."""
