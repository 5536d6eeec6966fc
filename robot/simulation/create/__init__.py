"""Simulated sessions of a whiskered Create in an arena."""
