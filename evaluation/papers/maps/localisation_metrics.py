"""Errors of poses in a map that is itself deformed.

A pose in a map is compared with the step of the map that is nearest in truth: the motion from that step to
the pose, in the map and in truth. So a map that is bent far from the robot does not count as an error of its
localisation; the error after a rigid alignment of the whole map to the truth is given beside it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Self

import numpy as np

from evaluation.metrics.trajectory import align
from tactile.base.se2 import between, compose, wrap

SAME_HEADING = np.radians(45)
"""Largest difference of headings of a step that is preferred as the nearest, rad."""


ROWS = 256
"""True poses that are compared with all steps of a map at once."""


class Tolerance(NamedTuple):
    """Largest error of position, m, and of heading, rad."""

    distance: float
    turn: float

    def holds(self, error: np.ndarray) -> np.ndarray:
        """[T] bool, whether errors [T, 2] are at most this in position and heading; False for NaN."""
        return (error[:, 0] <= self.distance) & (error[:, 1] <= self.turn)

    def exceeded(self, error: np.ndarray) -> np.ndarray:
        """[T] bool, whether errors [T, 2] are above this in position or heading; False for NaN."""
        return (error[:, 0] > self.distance) | (error[:, 1] > self.turn)


RIGHT = Tolerance(0.09, float(np.radians(20)))
"""A pose in a maze with cells of 0.18 m is right up to this error."""
WRONG = Tolerance(0.18, float(np.radians(30)))
"""A pose in such a maze is wrong from this error on."""
BUILDING = Tolerance(2.0, float(np.radians(30)))
"""A pose in a building is right up to this error, and wrong from it on."""


class MapSteps(NamedTuple):
    """Steps of a map whose true pose is known.

    Attributes:
        pose: [M, 3] in the map (m, m, rad). truth: [M, 3] true.
    """

    pose: np.ndarray
    truth: np.ndarray

    @classmethod
    def known(cls, pose: np.ndarray, truth: np.ndarray) -> Self:
        """Those of the steps [T, 3] that have a true pose."""
        known = np.isfinite(truth).all(axis=1)
        return cls(pose[known], truth[known])

    def nearest(self, truth: np.ndarray, reach: float) -> np.ndarray:
        """[T] the step that is nearest to each true pose [T, 3], with the same heading (up to
        `SAME_HEADING`) if there is one that is at most `reach` (m) farther away."""
        nearest = np.zeros(len(truth), int)
        for rows, distance, turn in self._apart(truth):
            nearest[rows] = np.argmin(distance + reach * (turn > SAME_HEADING), axis=1)
        return nearest

    def revisited(self, truth: np.ndarray, tolerance: Tolerance) -> np.ndarray:
        """[T] bool, whether a step is within the tolerance of each true pose [T, 3]."""
        revisited = np.zeros(len(truth), bool)
        for rows, distance, turn in self._apart(truth):
            revisited[rows] = ((distance <= tolerance.distance) & (turn <= tolerance.turn)).any(axis=1)
        return revisited

    def _apart(self, truth: np.ndarray) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """`ROWS` true poses at a time: their rows, and distance and turn [.., M] from each step."""
        for first in range(0, len(truth), ROWS):
            part = truth[first : first + ROWS, None]
            distance = np.hypot(*(self.truth[:, :2] - part[..., :2]).transpose(2, 0, 1))
            yield slice(first, first + ROWS), distance, np.abs(wrap(self.truth[:, 2] - part[..., 2]))

    def errors(self, pose: np.ndarray, truth: np.ndarray, reach: float) -> np.ndarray:
        """[T, 2] errors of position (m) and heading (rad, not negative) of poses in the map, against the
        nearest step; NaN where the truth is unknown.

        Args:
            pose: [T, 3] in the map. truth: [T, 3] true poses at the same times. reach: see `nearest`.
        """
        error = np.full((len(truth), 2), np.nan)
        known = np.isfinite(truth).all(axis=1)
        near = self.nearest(truth[known], reach)
        error[known] = pose_errors(
            between(self.pose[near], pose[known]), between(self.truth[near], truth[known])
        )
        return error

    def align(self, pose: np.ndarray) -> np.ndarray:
        """Poses [T, 3] of the map in the frame of the truth, after one rigid alignment of the map."""
        return compose(align(self.pose, self.truth), pose)

    def true_places(self, places: np.ndarray) -> np.ndarray:
        """[n, 2] where places [n, 2] of the map (m) are in truth: moved with the nearest step."""
        pose = np.column_stack([places, np.zeros(len(places))])
        distance = np.hypot(*(self.pose[:, :2] - places[:, None]).transpose(2, 0, 1))
        near = np.argmin(distance, axis=1)
        return compose(self.truth[near], between(self.pose[near], pose))[:, :2]


def pose_errors(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """[T, 2] distance (m) and turn (rad, not negative) between two rows of poses [T, 3]; NaN of NaN."""
    return np.column_stack([np.hypot(*(found - true)[:, :2].T), np.abs(wrap(found[:, 2] - true[:, 2]))])
