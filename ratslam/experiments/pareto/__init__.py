"""Speed against error: every configuration of a study in one table and one picture."""
