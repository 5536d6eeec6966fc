"""Conformance checks for registered backends, sources, touch front ends and metrics."""
