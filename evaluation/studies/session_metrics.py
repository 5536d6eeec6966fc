"""Metrics of Salman & Pearson 2016 on a session held in memory; closures, and laps that end at the start."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evaluation.metrics.energy_metric import energy_all_pairs
from evaluation.metrics.exm import ExmConfig, ExperienceMetric, experience_metric
from tactile.base.errors import InputError

FALSE_CLOSURE_DISTANCE = 0.1
"""A closure is false if its steps are farther apart in truth, m (Salman & Pearson 2016, III-G)."""
HOME_RADIUS = 0.09
"""A robot this near to its start has returned to it, m: half a micromouse cell."""


class SessionResult(NamedTuple):
    """The outcome of a session of T steps.

    Attributes:
        truth, odometry, trajectory: [T, 3] true, dead-reckoned and final mapped poses. place: [T] current
            experience, -1 for none. node: [M, 3] poses of the experiences in the final map.
        closures: [K, 2] later and earlier step of each loop closure. live: [T, 3] pose given at each step, in
            the map of that time. piece: [T] piece of the map of each step.
    """

    truth: np.ndarray
    odometry: np.ndarray
    trajectory: np.ndarray
    place: np.ndarray
    node: np.ndarray
    closures: np.ndarray
    live: np.ndarray
    piece: np.ndarray


class TouchMetrics(NamedTuple):
    """Metrics of one session; NaN where a metric is not defined.

    Attributes:
        em: Energy Metric over all pairs of steps of the final map, m^2 + rad^2. em_experiences: the same with
            each step at the pose of its experience. em_odometry: the same of dead reckoning.
        arr, arcr: strict Experience Metric. arcr_chain_free: share of the re-localisations within its
            thresholds, whether or not earlier ones were correct.
        relocalisations, closures: counts. false_closures: closures beyond `FALSE_CLOSURE_DISTANCE`.
        experiences: in the map. steps: of the session.
    """

    em: float
    em_experiences: float
    em_odometry: float
    arr: float
    arcr: float
    arcr_chain_free: float
    relocalisations: int
    closures: int
    false_closures: int
    experiences: int
    steps: int


def touch_metrics(result: SessionResult, exm: ExmConfig | None = None) -> TouchMetrics:
    """All metrics of one session."""
    truth, place = result.truth, result.place
    known = place >= 0
    metric = experience_metric_if_defined(result, exm)
    return TouchMetrics(
        em=energy_all_pairs(result.trajectory, truth).total,
        em_experiences=energy_all_pairs(result.node[place[known]], truth[known]).total,
        em_odometry=energy_all_pairs(result.odometry, truth).total,
        arr=metric.arr if metric else np.nan,
        arcr=metric.arcr if metric else np.nan,
        arcr_chain_free=metric.arcr_chain_free if metric else np.nan,
        relocalisations=metric.relocalisations if metric else 0,
        closures=len(result.closures),
        false_closures=int((closure_errors(result) > FALSE_CLOSURE_DISTANCE).sum()),
        experiences=len(result.node),
        steps=len(truth),
    )


def closure_errors(result: SessionResult) -> np.ndarray:
    """[K] true distance between the two steps of each closure, m."""
    later, earlier = result.truth[result.closures[:, 0]], result.truth[result.closures[:, 1]]
    return np.hypot(*(later - earlier)[:, :2].T)


def experience_metric_if_defined(
    result: SessionResult, exm: ExmConfig | None = None
) -> ExperienceMetric | None:
    """The Experience Metric; None where the robot never returned to its start or has no experience."""
    try:
        return experience_metric(result.place, result.truth, exm or ExmConfig())
    except InputError:
        return None


def lap_ends(truth: np.ndarray) -> np.ndarray:
    """[L] steps at which the robot returned to its start: the nearest step of each visit.

    Args:
        truth: [T, 3] true poses.
    """
    away = np.hypot(*(truth[:, :2] - truth[0, :2]).T)
    change = np.flatnonzero(np.diff((away < HOME_RADIUS).astype(int))) + 1
    visits = np.split(np.arange(len(truth)), change)[2::2]  # the path alternates: home, away, home, ...
    return np.array([visit[np.argmin(away[visit])] for visit in visits], int)
