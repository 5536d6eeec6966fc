"""Localisation in a finished map: the states of a session, and its course step by step."""

from __future__ import annotations

from enum import IntEnum
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ratslam.core.checkpoint import Checkpointed
from ratslam.core.growable_array import GrowableArray


class Localisation(IntEnum):
    """Whether the robot's pose in the map is known."""

    SEARCHING = 0
    """Not yet: the views so far fit several places, or none."""
    FOUND = 1
    """The pose is known."""
    LOST = 2
    """It was known, but the views since do not fit it, or none showed known ground for too long."""
    NOT_THIS_MAP = 3
    """So many views fit nowhere that the session is most likely not in this map, or in a part that was never
    driven."""


class LocalisedPose(NamedTuple):
    """Attributes:
    state: see `Localisation`. pose: [3] the most likely pose in the map, m, m, rad; by odometry alone where
        none is supposed. covariance: [3, 3] of it, were it the right one. mass: its probability against all
        other poses and against not being in this map. log_odds: of the session being there.
    """

    state: Localisation
    pose: np.ndarray
    covariance: np.ndarray
    mass: float
    log_odds: float


class LocalisedCourse(Checkpointed):
    """The states and poses of all steps of a session."""

    def __init__(self) -> None:
        self.pose = GrowableArray((3,), np.float64)
        self._states = GrowableArray((), np.int64)
        self._record = GrowableArray((3,), np.float64)

    def append(self, now: LocalisedPose) -> None:
        """Adds a step."""
        deviation = float(np.sqrt(max(np.linalg.eigvalsh(now.covariance[:2, :2])[1], 0.0)))
        self.pose.append(now.pose)
        self._states.append(int(now.state))
        self._record.append((now.mass, now.log_odds, deviation))

    def states(self) -> np.ndarray:
        """[T] the `Localisation` at each step."""
        return self._states.rows.copy()

    def write(self, path: Path) -> None:
        """Writes the course as CSV."""
        write_course(path, self._states.rows, self._record.rows)


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
