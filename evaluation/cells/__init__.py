"""Analysis of recorded pose cells."""
