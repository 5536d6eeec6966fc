"""Whiskers as curves in space, for drawing: straight at rest, bent to the points that they touch."""

from __future__ import annotations

import numpy as np

from tactile.whiskers.head_geometry import Head

POINTS = 9
"""Points along a drawn whisker."""


def whisker_curves(head: Head, contact: np.ndarray, point: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Curves [W, POINTS, 3] in base_link, m.

    A whisker in contact is a parabola from its base, where it keeps its direction at rest, to the point that
    it touches.

    Args:
        contact: [W] bool. point: [W, 2] contact points, m. height: [W] of the contacts above the floor, m.
    """
    rest = head.base + head.length[:, None] * head.rest
    end = np.where(contact[:, None], np.column_stack([point, height]), rest)
    middle = (head.base + rest) / 2
    share = np.linspace(0.0, 1.0, POINTS)[None, :, None]
    base, middle, end = (corner[:, None] for corner in (head.base, middle, end))
    return (1 - share) ** 2 * base + 2 * share * (1 - share) * middle + share**2 * end
