"""Simulated sessions of a whisker head on an arm and of a whiskered Create."""
