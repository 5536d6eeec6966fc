"""What single reproductions measure besides `TouchTrial`; each takes a session and the word of its laps."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from evaluation.metrics.experience_log import creation_rows
from ratslam.experiments.salman2016.protocols import LATER
from ratslam.experiments.trials.touch_trial import FALSE, Played, lap_ends

BESIDE = 0.02
"""Steps of the two directions so near in truth are at the same spot, m."""


def extras(result: Played, word: str) -> dict[str, float]:
    """All of them; NaN where the laps do not allow one."""
    return directions(result, word) | across(result)


def lap_of(truth: np.ndarray, count: int) -> np.ndarray:
    """[T] the number of each step's lap, from 0; the way after the last return belongs to the last.

    Args:
        count: laps at most.
    """
    ends = lap_ends(truth)
    return np.minimum(np.searchsorted(ends, np.arange(len(truth))), max(min(len(ends), count) - 1, 0))


def clockwise_steps(truth: np.ndarray, word: str) -> np.ndarray:
    """[T] whether a step is of a clockwise lap, by the laps' letters."""
    return np.array([letter == "C" for letter in word.upper()])[lap_of(truth, len(word))]


def directions(result: Played, word: str) -> dict[str, float]:
    """How laps the other way round were associated with clockwise ones.

    A step is associated with the clockwise step at which its experience was made or which a closure joins it
    to; where that is itself of an anticlockwise lap, with what that one is associated with. With its
    counterpart it is, if that lies within `FALSE` of it.
    """
    nothing = dict.fromkeys(
        ("counterparts", "first_anticlockwise", "last_anticlockwise", "rightly", "apart"), np.nan
    )
    if "A" not in word.upper() or "C" not in word.upper():
        return nothing
    truth, lap = result.truth, lap_of(result.truth, len(word))
    clockwise = clockwise_steps(truth, word)
    if clockwise.all():
        return nothing
    joined = _joined(result, clockwise)
    known = ~clockwise & (joined >= 0)
    near = known & (np.hypot(*(truth - truth[joined])[:, :2].T) < FALSE)
    laps = np.unique(lap[~clockwise])
    return {
        "counterparts": float(near[lap == laps[0]].mean()),
        "first_anticlockwise": float(known[lap == laps[0]].mean()),
        "last_anticlockwise": float(known[lap == laps[-1]].mean()),
        "rightly": float(near[known].mean()) if known.any() else np.nan,
        "apart": _apart(result, clockwise),
    }


def across(result: Played) -> dict[str, float]:
    """Closures that join what comes after the change of mazes with what came before."""
    change = int(LATER * len(result.truth))
    later, earlier = result.closures.reshape(-1, 2).T
    return {"across": float(((later >= change) & (earlier < change)).sum())}


def _joined(result: Played, clockwise: np.ndarray) -> np.ndarray:
    """[T] the clockwise step that each step is associated with, -1 for none; a clockwise one with itself."""
    made = np.where(result.place >= 0, creation_rows(result.place), -1)
    earlier: dict[int, list[int]] = {}
    for step, before in result.closures.tolist():
        earlier.setdefault(step, []).append(before)
    joined = np.where(clockwise, np.arange(len(clockwise)), -1)
    for step in np.flatnonzero(~clockwise).tolist():
        found = [joined[before] for before in (made[step], *earlier.get(step, [])) if 0 <= before < step]
        joined[step] = max(found, default=-1)  # any; the newest of several
    return joined


def _apart(result: Played, clockwise: np.ndarray) -> float:
    """How far the map puts steps of the two directions apart that are at the same spot, median, m."""
    ahead = np.flatnonzero(clockwise)
    away, row = cKDTree(result.truth[ahead, :2]).query(result.truth[~clockwise, :2])
    beside = away < BESIDE
    if not beside.any():
        return np.nan
    step = result.trajectory[~clockwise][beside, :2] - result.trajectory[ahead[row[beside]], :2]
    return float(np.median(np.hypot(*step.T)))
