"""Mazes, arenas, walls, routes and trajectories."""
