"""Simulated sessions of a whisker head on an arm, in three tiers of fidelity."""
