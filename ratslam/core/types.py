"""What an engine says at each step."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, NamedTuple

from tactile.base.types import Array

Scalar = Annotated[Array, "scalar"]
"""An array of shape (). A field of a backend's evidence with this annotation is a column of `steps.csv`."""


class Action(IntEnum):
    """What happened to the robot's place at a step."""

    NONE = 0
    """The place is still the same, or nothing was recognised."""
    CREATE = 1
    """A new place was made here."""
    LINK = 2
    """A known place was reached by a way not travelled before."""
    SET = 3
    """A known place was reached by a way already linked, or without a way at all (after a break)."""


class Estimate(NamedTuple):
    """What any backend reports at a step.

    Attributes:
        pose: [3] x m, y m, heading rad, in the backend's own frame (for the pose cells: on their torus).
        spread: [3] standard deviation of the pose, m, m, rad.
        place: id of the current place, int32; -1 before the first and for backends without places.
        previous: id of the place before this step, int32.
        action: an `Action`, int32.
        lost: whether the backend knows that it does not know where it is, bool.
    """

    pose: Array
    spread: Array
    place: Array
    previous: Array
    action: Array
    lost: Array
