"""The Bayes filter over keyframes and its observation models."""
