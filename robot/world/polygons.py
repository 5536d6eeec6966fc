"""Polygons in the plane: containment, distances and crossings.

A polygon is [N, 2] corners in order, m, implicitly closed; a segment is a row x1, y1, x2, y2.
"""

from __future__ import annotations

import numpy as np


def polygon_edges(polygon: np.ndarray) -> np.ndarray:
    """The sides [N, 4] of a polygon."""
    return np.hstack([polygon, np.roll(polygon, -1, axis=0)])


def polygon_area(polygon: np.ndarray) -> float:
    """Area of a polygon, m^2; positive if its corners are in counter-clockwise order."""
    x, y = polygon.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2)


def polygon_contains(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[...] bool, whether points [..., 2] are inside, by the number of sides to their right."""
    points = np.asarray(points, np.float64)[..., None, :]
    x1, y1, x2, y2 = polygon_edges(polygon).T
    x, y = points[..., 0], points[..., 1]
    spans = (y1 > y) != (y2 > y)
    run = np.where(y2 == y1, 1.0, y2 - y1)  # avoids a division by 0; a horizontal side spans no height
    right = x < x1 + (y - y1) * (x2 - x1) / run
    return np.logical_xor.reduce(spans & right, axis=-1)


def segment_distance(segments: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances [..., S] from points [..., 2] to segments [S, 4], m."""
    points = np.asarray(points, np.float64)[..., None, :]
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    away = points - start
    square = np.maximum((along**2).sum(axis=-1), 1e-300)
    share = np.clip((away * along).sum(axis=-1) / square, 0.0, 1.0)
    return np.linalg.norm(away - share[..., None] * along, axis=-1)


def segments_cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[S, R] bool, whether segments [S, 4] and [R, 4] cross; touching does not count."""

    def side(segments: np.ndarray, points: np.ndarray) -> np.ndarray:
        start, along = segments[:, None, :2], segments[:, None, 2:] - segments[:, None, :2]
        away = points[None] - start
        turned = along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0]
        size = np.linalg.norm(along, axis=-1) * np.maximum(np.linalg.norm(away, axis=-1), 1e-300)
        return np.sign(np.where(np.abs(turned) > 1e-9 * size, turned, 0.0))

    there = side(one, other[:, :2]) * side(one, other[:, 2:]) < 0
    back = side(other, one[:, :2]) * side(other, one[:, 2:]) < 0
    return there & back.T


def polygon_gap(one: np.ndarray, other: np.ndarray) -> float:
    """Distance between the outlines of two polygons, m; 0 if they cross or touch."""
    sides, others = polygon_edges(one), polygon_edges(other)
    if segments_cross(sides, others).any():
        return 0.0
    return float(min(segment_distance(sides, other).min(), segment_distance(others, one).min()))


def square(centre: np.ndarray, side: float, angle: float) -> np.ndarray:
    """Corners [4, 2] of a square that is rotated by an angle (rad)."""
    corner = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * side / 2
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(centre, np.float64) + corner @ np.array([[c, s], [-s, c]])
