"""Foundations that every package may import: types, SE(2), errors, settings, random streams."""
