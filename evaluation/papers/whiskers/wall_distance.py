"""Distance from a robot to the nearest wall when its bumper is pressed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robot.world.polygons import segment_distance


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
    distance = segment_distance(walls, position).min(axis=1)
    begins = pressed & ~np.concatenate([[False], pressed[:-1]])
    return WallDistances(distance[begins], distance)
