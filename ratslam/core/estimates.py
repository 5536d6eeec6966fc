"""What a step tells: the estimate of the pose, the change of the robot's place, what is drawn of a map; and
the states of a session that is localised in a finished map, step by step.
"""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from typing import Annotated, NamedTuple

import jax.numpy as jnp
import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
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

    @classmethod
    def without_place(cls, pose: Array, spread: Array, lost: Array) -> Estimate:
        """That of a kernel which assigns no place: its map does, or it has none."""
        none = jnp.int32(-1)
        return cls(pose, spread, none, none, jnp.int32(Action.NONE), lost)


class Localisation(IntEnum):
    """Whether the robot's pose in the map is known."""

    SEARCHING = 0
    """Not yet: the views so far fit several places, or none."""
    FOUND = 1
    """The pose is known."""
    LOST = 2
    """It was known, but the views since do not fit it, or none showed known ground for too long."""
    NOT_THIS_MAP = 3
    """Most views match no keyframe: the session is most likely not in this map, or in a part that was never
    driven."""

    def after(self, *, found: bool, lost: bool, likely: bool, unexplained: bool) -> Localisation:
        """The state after the poses that the robot may have were judged once more, in maps of all methods.

        Args:
            found: one is likely enough, and likelier than any other by far. lost: the known one is so no
                longer. likely: one has half the evidence of a known one. unexplained: in this map one would
                have been found by now.
        """
        if found:
            return Localisation.FOUND
        if self == Localisation.FOUND:
            return Localisation.LOST if lost else self
        if likely:
            return Localisation.SEARCHING if self == Localisation.NOT_THIS_MAP else self
        return Localisation.NOT_THIS_MAP if unexplained else self


class LocalisedPose(NamedTuple):
    """The pose of a session in a finished map at one step.

    Attributes:
        state: see `Localisation`. pose: [3] the most likely pose in the map, m, m, rad; by odometry alone
            while there is no hypothesis. covariance: [3, 3] of it, if it is the right one. mass: its
            probability against all other poses and against not being in this map. log_odds: of the session
            being there.
    """

    state: Localisation
    pose: np.ndarray
    covariance: np.ndarray
    mass: float
    log_odds: float

    def complete(self, estimate: Estimate) -> Estimate:
        """The estimate of a backend with this pose instead of its own."""
        dtype = np.asarray(estimate.pose).dtype
        return estimate._replace(
            pose=self.pose.astype(dtype),
            spread=np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).astype(dtype),
            lost=np.bool_(self.state != Localisation.FOUND),
            action=np.int32(Action.NONE),
            place=np.int32(-1),
        )


class LocalisedCourse(Checkpointed):
    """The poses and states of all steps of a session, and what `write_course` writes of them."""

    def __init__(self) -> None:
        self.pose = GrowableArray((3,), np.float64)
        self.states = GrowableArray((), np.int64)
        self.record = GrowableArray((3,), np.float64)

    def append(self, now: LocalisedPose, deviation: float) -> None:
        """Adds a step; deviation: see `write_course`."""
        self._append_row(now.pose, int(now.state), (now.mass, now.log_odds, deviation))


def pieces_of(states: np.ndarray) -> np.ndarray:
    """[T] the piece of each step with these states [T]: all steps where the pose was found are one, and so is
    each stretch between."""
    found = states == Localisation.FOUND
    begins = np.diff(found.astype(int), prepend=0) < 0
    kinds = np.where(found, -1, np.cumsum(begins))
    _, first, row = np.unique(kinds, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[row]  # numbered as they appear


def write_course(path: Path, states: np.ndarray, record: np.ndarray) -> None:
    """Writes a session as CSV: states [T], and of each step [T, 3] mass, log-odds and the standard deviation
    of the position in the direction where it is largest, m."""
    lines = ["step,state,mass,log_odds,sd"]
    rows = zip(states.tolist(), record.tolist(), strict=True)
    for step, (state, (mass, log_odds, deviation)) in enumerate(rows):
        name = Localisation(state).name.lower()
        lines.append(f"{step},{name},{mass!r},{log_odds!r},{deviation!r}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
