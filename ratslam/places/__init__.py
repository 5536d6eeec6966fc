"""Saved maps used again and cared for: localisation, joining, routes, change, crop, differences."""
