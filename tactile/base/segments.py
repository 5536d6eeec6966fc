"""Distances of points from straight segments in the plane."""

from __future__ import annotations

import numpy as np


def segment_distances(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n, E] distances of points [n, 2] from the segments between a and b [E, 2], in their unit."""
    points, along = np.asarray(points, float).reshape(-1, 1, 2), b - a
    size = (along**2).sum(axis=-1)
    size = np.where(size > 0, size, 1.0)  # a segment may be a point
    share = np.clip(((points - a) * along).sum(axis=-1) / size, 0.0, 1.0)
    return np.linalg.norm(points - (a + share[..., None] * along), axis=-1)


def line_distances(points: np.ndarray, line: np.ndarray) -> np.ndarray:
    """[n] distances of points [n, 2] from the line through points [K, 2], K >= 1."""
    ends = (line[:-1], line[1:]) if len(line) > 1 else (line, line)
    return segment_distances(points, *ends).min(axis=1)
