"""Metrics of trajectories, experiences and grids."""
