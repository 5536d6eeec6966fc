"""Simulated sessions of a rat in a box with cues."""
