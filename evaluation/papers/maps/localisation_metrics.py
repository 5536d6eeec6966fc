"""Errors of poses in a map that is itself deformed.

A pose in a map is compared with the step of the map that is nearest in truth: the motion from that step to
the pose, in the map and in truth. So a map that is bent far from the robot does not count as an error of its
localisation; the error after a rigid alignment of the whole map to the truth is given beside it.
"""

from __future__ import annotations

from typing import NamedTuple

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


def known_steps(pose: np.ndarray, truth: np.ndarray) -> MapSteps:
    """The steps [T, 3] that have a true pose."""
    known = np.isfinite(truth).all(axis=1)
    return MapSteps(pose[known], truth[known])


def nearest_steps(steps: MapSteps, truth: np.ndarray, reach: float) -> np.ndarray:
    """[T] the step of the map that is nearest to each true pose [T, 3], with the same heading (up to
    `SAME_HEADING`) if there is one that is at most `reach` (m) farther away."""
    nearest = np.zeros(len(truth), int)
    for first in range(0, len(truth), ROWS):
        part = truth[first : first + ROWS, None]
        distance = np.hypot(*(steps.truth[:, :2] - part[..., :2]).transpose(2, 0, 1))
        turned = np.abs(wrap(steps.truth[:, 2] - part[..., 2])) > SAME_HEADING
        nearest[first : first + ROWS] = np.argmin(distance + reach * turned, axis=1)
    return nearest


def localisation_errors(steps: MapSteps, pose: np.ndarray, truth: np.ndarray, reach: float) -> np.ndarray:
    """[T, 2] errors of position (m) and heading (rad, not negative) of poses in a map, against the nearest
    step of the map; NaN where the truth is unknown.

    Args:
        pose: [T, 3] in the map. truth: [T, 3] true poses at the same times. reach: see `nearest_steps`.
    """
    error = np.full((len(truth), 2), np.nan)
    known = np.isfinite(truth).all(axis=1)
    near = nearest_steps(steps, truth[known], reach)
    found = between(steps.pose[near], pose[known])
    true = between(steps.truth[near], truth[known])
    error[known] = _sizes(found, true)
    return error


def aligned_errors(steps: MapSteps, pose: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[T, 2] errors of position (m) and heading (rad, not negative) of poses [T, 3] in a map after one rigid
    alignment of the map to the truth; NaN where the truth is unknown."""
    return _sizes(compose(align(steps.pose, steps.truth), pose), truth)


def exceeds(error: np.ndarray, tolerance: Tolerance) -> np.ndarray:
    """[T] bool, whether errors [T, 2] are above a tolerance in position or heading; False for NaN."""
    return (error[:, 0] > tolerance.distance) | (error[:, 1] > tolerance.turn)


def is_within(error: np.ndarray, tolerance: Tolerance) -> np.ndarray:
    """[T] bool, whether errors [T, 2] are at most a tolerance in position and heading; False for NaN."""
    return (error[:, 0] <= tolerance.distance) & (error[:, 1] <= tolerance.turn)


def is_revisited(steps: MapSteps, truth: np.ndarray, tolerance: Tolerance) -> np.ndarray:
    """[T] bool, whether a step of the map is within the tolerance of each true pose [T, 3]."""
    revisited = np.zeros(len(truth), bool)
    for first in range(0, len(truth), ROWS):
        part = truth[first : first + ROWS, None]
        near = np.hypot(*(steps.truth[:, :2] - part[..., :2]).transpose(2, 0, 1)) <= tolerance.distance
        same = np.abs(wrap(steps.truth[:, 2] - part[..., 2])) <= tolerance.turn
        revisited[first : first + ROWS] = (near & same).any(axis=1)
    return revisited


def true_places(steps: MapSteps, places: np.ndarray) -> np.ndarray:
    """[n, 2] where places [n, 2] of the map (m) are in truth: moved with the nearest step of the map."""
    pose = np.column_stack([places, np.zeros(len(places))])
    distance = np.hypot(*(steps.pose[:, :2] - places[:, None]).transpose(2, 0, 1))
    near = np.argmin(distance, axis=1)
    return compose(steps.truth[near], between(steps.pose[near], pose))[:, :2]


def _sizes(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """[T, 2] distance and turn between two rows of poses."""
    return np.column_stack([np.hypot(*(found - true)[:, :2].T), np.abs(wrap(found[:, 2] - true[:, 2]))])
