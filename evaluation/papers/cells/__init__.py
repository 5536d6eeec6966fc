"""Pose cells measured as neurons: figures, scores, cost."""
