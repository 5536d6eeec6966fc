"""The pose-cell continuous attractor network and its adaptive window."""
