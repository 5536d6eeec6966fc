"""The force at the tool of an arm: walls as springs, and what an arm measures besides, for simulation and
emulator alike.

An arm without a force sensor infers the force from its joints: the value is noisy, has an offset where the
payload is not the one that it was told, and drifts by some newtons from pose to pose.
"""

from __future__ import annotations

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from tactile.base.settings import Settings

GRAVITY = 9.81  # m/s^2
WAVES = np.array([[7.0, 2.0], [-3.0, 8.0], [5.0, -6.0]])
"""Wave numbers of the drift along x and y, rad/m, for each axis of the force: most of a turn in 1 m."""
MARCHES = 64
"""Steps by which a ray approaches a wall, at most."""


class ContactForceConfig(Settings):
    """Walls as the tool of an arm feels them, and errors of the measured force."""

    stiffness: PositiveFloat = 5000.0
    """Force by depth in a wall, N/m: foam has about 500, a bolted wall 20,000."""
    noise: NonNegativeFloat = 1.0
    """Standard deviation of each component in a state, N."""
    drift: NonNegativeFloat = 2.0
    """Amplitude of the error of each component over the poses, N."""
    payload: float = 0.2
    """Mass at the flange that the arm was not told of, kg."""


def force_error(config: ContactForceConfig, place: np.ndarray) -> np.ndarray:
    """Error [..., 3] of the force without noise, N, at places [..., 2 or more] of the tool, m."""
    drift = config.drift * np.sin(np.asarray(place)[..., :2] @ WAVES.T)
    return drift - np.array([0.0, 0.0, GRAVITY * config.payload])


def wall_distance(boxes: np.ndarray, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance [...] of places [..., 2] from the nearest of boxes [B, 4] (west, south, east, north), negative
    inside, m; and the direction [..., 2] away from it."""
    place = np.asarray(place, np.float64)[..., None, :]
    low, high = place - boxes[:, 2:], boxes[:, :2] - place  # negative where it is beside the far side
    beyond = np.maximum(np.maximum(low, high), 0.0)  # [..., B, 2]
    inside = np.maximum(low, high).max(axis=-1)
    distance = np.where(inside > 0, np.hypot(beyond[..., 0], beyond[..., 1]), inside)
    nearest = distance.argmin(axis=-1)[..., None]
    gap = np.take_along_axis(distance, nearest, axis=-1)[..., 0]

    def of_nearest(values: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, nearest[..., None], axis=-2)[..., 0, :]

    sides = np.where(low > high, 1.0, -1.0)
    beyond, sides = of_nearest(beyond), of_nearest(sides)
    length = np.hypot(beyond[..., 0], beyond[..., 1])[..., None]
    only = of_nearest(np.maximum(low, high)).argmax(axis=-1)[..., None] == np.arange(2)
    outwards = np.where(length > 0, beyond * sides / np.where(length > 0, length, 1.0), only * sides)
    return gap, outwards


def free_way(
    boxes: np.ndarray, radius: float, start: np.ndarray, angle: np.ndarray, reach: float
) -> np.ndarray:
    """Way [P, D] that a round tool moves from places [P, 2] in directions [P, D] (rad) until it touches a box
    [B, 4], m; infinite beyond `reach`."""
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    way = np.zeros(angle.shape)
    going = np.ones(angle.shape, bool)
    for _ in range(MARCHES):  # each step is the distance to the nearest wall: it cannot pass one
        row, column = np.nonzero(going)
        if not len(row):
            break
        place = start[row] + way[row, column, None] * along[row, column]
        gap = wall_distance(boxes, place)[0] - radius
        way[row, column] += np.maximum(gap, 0.0)
        going[row, column] = (gap > 1e-6) & (way[row, column] < reach)
    return np.where(way < reach, way, np.inf)
