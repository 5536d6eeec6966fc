"""Distance from a robot to the nearest wall when its bumper is pressed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class WallDistances(NamedTuple):
    """Distances from the robot's true position to the nearest wall, m: [E] at the first reading of each
    contact, and [T] at all readings."""

    contact: np.ndarray
    all: np.ndarray


def wall_distances(position: np.ndarray, pressed: np.ndarray, walls: np.ndarray) -> WallDistances:
    """The distances along a true path.

    Args:
        position: [T, 2], m. pressed: [T] bool, a bumper is pressed. walls: [W, 4] ends x1, y1, x2, y2, m.
    """
    distance = np.min([_segment_distance(position, wall) for wall in walls], axis=0)
    begins = pressed & ~np.concatenate([[False], pressed[:-1]])
    return WallDistances(distance[begins], distance)


def _segment_distance(position: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """[T] distance of positions [T, 2] from a segment [4]."""
    start, along = wall[:2], wall[2:] - wall[:2]
    share = np.clip((position - start) @ along / max(float(along @ along), 1e-12), 0, 1)
    return np.linalg.norm(position - start - share[:, None] * along, axis=1)
