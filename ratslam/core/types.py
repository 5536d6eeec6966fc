"""The estimate of one step, and the change of the robot's place."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, NamedTuple

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
