"""The estimate of one step, and the change of the robot's place."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, NamedTuple

import numpy as np

from tactile.base.types import Array

Scalar = Annotated[Array, "scalar"]
"""An array of shape (). A field of a backend's evidence with this annotation is a column of `steps.csv`."""


class Action(IntEnum):
    """Change of the robot's place in a step."""

    NONE = 0
    """The place is the same as before, or no place was recognised."""
    CREATE = 1
    """A new place was created here."""
    LINK = 2
    """A known place was reached by a new link."""
    SET = 3
    """A known place was reached by an existing link, or without a link (after an odometry break)."""


class PoseCellActivity(NamedTuple):
    """Activity of a pose-cell network, host arrays.

    Attributes:
        xy: [N, N] sum over the headings, rows are y. heading: [K] sum over x and y. packets: [n, 4] poses in
            the map and activity of the packets that compete, heaviest first, m, m, rad; None of a network
            whose activity is no posterior.
    """

    xy: np.ndarray
    heading: np.ndarray
    packets: np.ndarray | None = None


class GridDrawing(NamedTuple):
    """An occupancy grid.

    Attributes:
        probability: [H, W] of an obstacle, rows are y upwards. origin: [2] lower left corner, m.
        cell: side of a cell, m.
    """

    probability: np.ndarray
    origin: np.ndarray
    cell: float


class Estimate(NamedTuple):
    """Estimate of any backend after one step.

    Attributes:
        pose: [3] x m, y m, heading rad, in the backend's own frame (pose cells: on their torus).
        spread: [3] standard deviation of the pose, m, m, rad.
        place: id of the current place, int32; -1 before the first and for backends without places.
        previous: id of the place before this step, int32.
        action: an `Action`, int32.
        lost: whether the backend has lost track of the robot's position, bool.
    """

    pose: Array
    spread: Array
    place: Array
    previous: Array
    action: Array
    lost: Array
