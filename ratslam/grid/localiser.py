"""Localisation of a session in a finished grid map, which does not change."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ratslam.core.backend import Map
from ratslam.core.checkpoint import Checkpointed
from ratslam.core.estimates import Action, Estimate, GridDrawing
from ratslam.core.localisation import Localisation, LocalisedCourse, LocalisedPose, pieces_of
from tactile.base.types import Observation

UNEXPLAINED = 4
"""The session is not in the map if this many searches in a row have failed."""
LEAST_SHARE = 0.5
"""Share of the supposed poses that are the best one below which a found pose is lost."""


class SavedGrid(NamedTuple):
    """What a session shows of the map that it is localised in.

    Attributes:
        grid: the drawn map. digest: numbers that tell it from other maps.
    """

    grid: GridDrawing
    digest: np.ndarray


class GridLocaliser(Checkpointed, Map):
    """The map of the localise backend for grid maps: the poses of a session in a finished map.

    Args:
        saved: the finished map. log_odds: above which a pose is found.
        known: whether the session is supposed to begin at a known pose.
    """

    VALUES = ("_state", "_failed", "_now_pose", "_now_covariance", "_now_mass", "_now_log_odds")
    PARTS = ("_course",)

    def __init__(self, saved: SavedGrid, log_odds: float, known: bool = False) -> None:
        self.saved, self._needed = saved, log_odds
        self._state = int(Localisation.FOUND if known else Localisation.SEARCHING)
        self._failed = 0  # searches that failed in a row
        self._now_pose, self._now_covariance = np.zeros(3), np.zeros((3, 3))
        self._now_mass, self._now_log_odds = 0.0, 0.0
        self._course = LocalisedCourse()

    # Queries

    def localisation(self) -> LocalisedPose:
        """The robot's pose now, and whether it is known."""
        return LocalisedPose(
            Localisation(self._state), self._now_pose, self._now_covariance, self._now_mass,
            self._now_log_odds,
        )  # fmt: skip

    def pose(self, estimate: Estimate) -> np.ndarray:
        del estimate
        return self._now_pose.copy()

    def trajectory(self) -> np.ndarray:
        """[T, 3] poses of all steps: the most likely one at that time, whether it was believed or not."""
        return self._course.pose.rows.copy()

    def states(self) -> np.ndarray:
        """[T] the `Localisation` at each step."""
        return self._course.states()

    def pieces(self) -> np.ndarray:
        return pieces_of(self._course.states())

    def grid(self) -> GridDrawing:
        """The finished map."""
        return self.saved.grid

    def files(self) -> dict[str, Callable[[Path], None]]:
        """State, mass and log-odds of every step as CSV, and the finished map."""
        return {"localisation.csv": self._course.write, "grid.npz": self._write}

    # Changes

    def update(self, observation: Observation, estimate: Estimate, evidence: Any) -> Estimate:
        """Judges the most likely pose after a report."""
        del observation
        self._now_pose = np.asarray(evidence.pose, float)
        self._now_covariance = np.asarray(evidence.covariance, float)
        share, odds = float(evidence.share), float(evidence.log_odds)
        self._now_log_odds = odds
        self._now_mass = share * _chance(odds - self._needed)
        self._judge(share, odds, bool(evidence.failed))
        now = self.localisation()
        self._course.append(now)
        dtype = np.asarray(estimate.pose).dtype
        return estimate._replace(
            pose=now.pose.astype(dtype),
            spread=np.sqrt(np.maximum(np.diag(now.covariance), 0.0)).astype(dtype),
            lost=np.bool_(now.state != Localisation.FOUND),
            action=np.int32(Action.NONE),
            place=np.int32(-1),
        )

    def arrays(self) -> dict[str, np.ndarray]:
        """The whole state, with what tells the finished map from others."""
        return super().arrays() | {"digest": self.saved.digest.copy()}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces the whole state by that of `arrays`.

        Raises:
            ValueError: the finished map has changed since.
        """
        if not np.array_equal(arrays["digest"], self.saved.digest):
            raise ValueError("a session in another map, or in this one before it was changed")
        super().restore(arrays)

    def _judge(self, share: float, odds: float, failed: bool) -> None:
        """Finds, keeps or loses the pose."""
        known = self._state == Localisation.FOUND
        if failed:
            self._failed += 1
            if known:
                self._state, self._failed = int(Localisation.LOST), 0
            elif self._failed >= UNEXPLAINED:
                self._state = int(Localisation.NOT_THIS_MAP)
        elif odds >= self._needed and share >= _chance(self._needed / 2):
            self._state, self._failed = int(Localisation.FOUND), 0
        elif known and share < LEAST_SHARE:
            self._state = int(Localisation.LOST)
        elif odds >= self._needed / 2:
            self._failed = 0
            if self._state == Localisation.NOT_THIS_MAP:
                self._state = int(Localisation.SEARCHING)

    def _write(self, path: Path) -> None:
        np.savez_compressed(path, **self.saved.grid._asdict())


def _chance(log_odds: float) -> float:
    return float(1 / (1 + np.exp(-np.clip(log_odds, -700, 700))))
