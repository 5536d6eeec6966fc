"""Saved maps used again: localisation, joining, routes and change."""
