"""Touch sessions repeated over mazes and seeds."""
