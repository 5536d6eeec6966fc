"""Figures on recordings of real whiskers and real wheels (see README.md)."""
