"""Geometry and control of whiskers."""
