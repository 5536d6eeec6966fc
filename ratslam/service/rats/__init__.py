"""Pose cells as a neuroscientist uses them: spikes, RatInABox."""
