"""Metrics of laps in two directions (Salman & Pearson 2016, IV-B), and of closures across a change."""

from __future__ import annotations

import numpy as np

from evaluation.metrics.experience_log import creation_rows
from evaluation.studies.session_metrics import FALSE_CLOSURE_DISTANCE, SessionResult, lap_ends

BESIDE = 0.02
"""Steps of the two directions this near in truth count as the same spot, m."""
DIRECTION_METRICS = (
    "first_anticlockwise_correct", "first_anticlockwise", "last_anticlockwise", "associated_correct",
    "directions_apart", "across",
)  # fmt: skip


def direction_metrics(result: SessionResult, laps: str, change: float) -> dict[str, float]:
    """How anticlockwise laps were associated with clockwise ones; NaN where the laps do not define a metric.

    A step is associated with the clockwise step at which its experience was created or to which a closure
    joins it; if that step is anticlockwise too, with the step that one is associated with. The association is
    correct if the two steps are within `FALSE_CLOSURE_DISTANCE`.

    Args:
        laps: direction of each lap, C or A. change: share of the session before the change of the world.

    Returns:
        first_anticlockwise_correct: share of the first anticlockwise lap with a correct association.
        first_anticlockwise, last_anticlockwise: share of the lap with an association. associated_correct:
        share of the associations that are correct. directions_apart: median distance in the map of steps of
        the two directions at the same spot, m. across: closures between the parts before and after the
        change.
    """
    truth = result.truth
    first_after = int(change * len(truth))
    later, earlier = result.closures.reshape(-1, 2).T
    metrics = dict.fromkeys(DIRECTION_METRICS, np.nan)
    metrics["across"] = float(((later >= first_after) & (earlier < first_after)).sum())
    if not {"A", "C"} <= set(laps.upper()) or (clockwise := clockwise_steps(truth, laps)).all():
        return metrics
    lap = lap_of_step(truth, len(laps))
    joined = _associate(result, clockwise)
    known = ~clockwise & (joined >= 0)
    correct = known & (np.hypot(*(truth - truth[joined])[:, :2].T) < FALSE_CLOSURE_DISTANCE)
    first, last = np.unique(lap[~clockwise])[[0, -1]]
    return metrics | {
        "first_anticlockwise_correct": float(correct[lap == first].mean()),
        "first_anticlockwise": float(known[lap == first].mean()),
        "last_anticlockwise": float(known[lap == last].mean()),
        "associated_correct": float(correct[known].mean()) if known.any() else np.nan,
        "directions_apart": _directions_apart(result, clockwise),
    }


def lap_of_step(truth: np.ndarray, count: int) -> np.ndarray:
    """[T] number of each step's lap, below `count`; steps after the last return belong to the last lap."""
    ends = lap_ends(truth)
    return np.minimum(np.searchsorted(ends, np.arange(len(truth))), max(min(len(ends), count) - 1, 0))


def clockwise_steps(truth: np.ndarray, laps: str) -> np.ndarray:
    """[T] whether a step belongs to a clockwise lap."""
    return np.array([letter == "C" for letter in laps.upper()])[lap_of_step(truth, len(laps))]


def _associate(result: SessionResult, clockwise: np.ndarray) -> np.ndarray:
    """[T] the clockwise step that each step is associated with, -1 for none; a clockwise one with itself."""
    created = np.where(result.place >= 0, creation_rows(result.place), -1)
    earlier: dict[int, list[int]] = {}
    for step, before in result.closures.tolist():
        earlier.setdefault(step, []).append(before)
    joined = np.where(clockwise, np.arange(len(clockwise)), -1)
    for step in np.flatnonzero(~clockwise).tolist():
        found = [joined[before] for before in (created[step], *earlier.get(step, [])) if 0 <= before < step]
        joined[step] = max(found, default=-1)  # the newest of several
    return joined


def _directions_apart(result: SessionResult, clockwise: np.ndarray) -> float:
    from scipy.spatial import cKDTree

    ahead = np.flatnonzero(clockwise)
    away, row = cKDTree(result.truth[ahead, :2]).query(result.truth[~clockwise, :2])
    beside = away < BESIDE
    step = result.trajectory[~clockwise][beside, :2] - result.trajectory[ahead[row[beside]], :2]
    return float(np.median(np.hypot(*step.T))) if len(step) else np.nan
