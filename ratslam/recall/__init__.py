"""The Bayes filter over remembered frames and its observation models."""
