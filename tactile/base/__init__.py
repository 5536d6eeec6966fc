"""Foundations for all packages: types, SE(2), errors, settings, random streams, atomic file writes."""
