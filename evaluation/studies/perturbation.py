"""Perturbed copies of a recording, to test the robustness of results.

Each copy is drawn from one seed: `perturb` changes start, noise, views and place labels a little, as another
drive would, and `repeat_course` makes one long drive of it; `miscalibrate` gives the odometry errors that
last; `spoil_labels` spoils a third of the given place labels and nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from robot.sources.in_memory import InMemorySource, select_rows
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose

VIEW_NOISE = 0.01
"""Standard deviation of the noise added to view values."""
LENGTH_NOISE = 0.02
"""Standard deviation of the scale of each forward motion, in both kinds of copies."""
TURN_NOISE = 0.01
"""Standard deviation added to the turn between two views, rad."""
START = (10, 80)
"""Smallest and largest number of views left out at the start."""
DROPPED = 0.05
"""Fraction of views that are dropped."""
NEW_IDS, WRONG_IDS = 0.1, 0.05
"""Fractions of given place labels replaced by new labels, and by labels of other rows."""
HEADING_BIAS = 0.01
"""Standard deviation of one heading error for the whole copy, rad/m."""
LENGTH_SCALE = 0.02
"""Standard deviation of one scale error of all lengths of the copy, as a fraction."""
TURN_PER_RADIAN, TURN_PER_METRE = 0.02, 0.005
"""Standard deviations of each row's heading noise: per radian that it turned, and per metre that it moved."""
MISCALIBRATED_DROPPED = 0.1
"""Fraction of views that are dropped from a miscalibrated copy."""
SPOILT_LABELS = 1 / 3
"""Fraction of the place labels that are lost, wrong or new."""

Perturbation = Callable[[InMemorySource, int], InMemorySource]
"""A copy of a recording, drawn from a seed."""


def perturb(log: InMemorySource, seed: int) -> InMemorySource:
    """A copy with another start, additional noise, dropped views and wrong place labels.

    Rows with a dropped view are removed and their motion is added to the next row, so the path is complete.
    The digest of the copy is that of the original followed by the seed.
    """
    stream = np.random.default_rng(seed)
    first = _draw_start(_looks(log), stream)
    changed = replace(_add_noise(log, stream), digest=f"{log.digest}+{seed}")
    return _drop_rows(changed, first, DROPPED, stream)


def repeat_course(log: InMemorySource, length: int, seed: int) -> InMemorySource:
    """The course of a recording driven again and again, for `length` rows; each has noise of its own, as in
    `perturb`. From its last row the robot gets to the first one by their true motion.

    Raises:
        InputError: the true pose of the first or of the last row is unknown.
    """
    if log.truth is None or not np.isfinite(log.truth[[0, -1]]).all():
        raise InputError(log.name, "no true pose of its first and last row", "a course that can be repeated")
    number, row = np.divmod(np.arange(length), log.length)
    step = float(log.time[-1] - log.time[0]) / max(log.length - 1, 1)
    long = select_rows(log, row)
    again = (row == 0) & (number > 0)
    long.motion[again] = *between(log.truth[-1], log.truth[0]), step
    long.moved[again] = True
    time = long.time + number * (float(log.time[-1] - log.time[0]) + step)
    digest = f"{log.digest}*{length}+{seed}"
    return replace(_add_noise(long, np.random.default_rng(seed)), time=time, digest=digest)


def _add_noise(log: InMemorySource, stream: np.random.Generator) -> InMemorySource:
    """The recording with noise of motions, views and place labels."""
    looks = _looks(log)
    apart = max(float(np.diff(looks).mean()), 1.0) if len(looks) > 1 else 1.0
    motion = log.motion.copy()
    motion[:, :2] *= 1 + LENGTH_NOISE * stream.standard_normal((len(motion), 1))
    moving = log.motion[:, :3].any(axis=1)
    motion[:, 2] += moving * TURN_NOISE / np.sqrt(apart) * stream.standard_normal(len(motion))
    noise = VIEW_NOISE * stream.standard_normal(log.views.shape)
    views = np.where(log.seen[:, None, None, None], np.clip(log.views + noise, 0, 1), log.views)
    # Some labels are replaced by new labels, and some by labels of other rows.
    given = np.flatnonzero(log.label >= 0)
    label, chance = log.label.copy(), stream.random(len(given))
    new, wrong = given[chance < NEW_IDS], given[(chance >= NEW_IDS) & (chance < NEW_IDS + WRONG_IDS)]
    label[wrong] = stream.permutation(label[given])[: len(wrong)]
    label[new] = label.max(initial=0) + 1 + np.arange(len(new))
    return replace(log, motion=motion, views=views, label=label)


def miscalibrate(log: InMemorySource, seed: int) -> InMemorySource:
    """A copy with another start, dropped views, and odometry errors that last besides noise of each row.

    One heading bias per metre and one scale of all lengths hold for the whole copy. Each row's length has
    noise in proportion to it, its turn noise in proportion to the turn and to the length, independent from
    row to row: the more rows, the better it averages out. Rows are dropped as by `perturb`.
    """
    stream = np.random.default_rng(seed)
    first = _draw_start(_looks(log), stream)
    bias = HEADING_BIAS * stream.standard_normal()
    scale = 1 + LENGTH_SCALE * stream.standard_normal()
    length, turn = np.hypot(*log.motion[:, :2].T), np.abs(log.motion[:, 2])
    moved, by_turn, by_length = stream.standard_normal((3, log.length))

    motion = log.motion.copy()
    motion[:, :2] *= (scale * (1 + LENGTH_NOISE * moved))[:, None]
    motion[:, 2] += bias * length + TURN_PER_RADIAN * turn * by_turn + TURN_PER_METRE * length * by_length
    changed = replace(log, digest=f"{log.digest}+miscalibrated {seed}", motion=motion)
    return _drop_rows(changed, first, MISCALIBRATED_DROPPED, stream)


def spoil_labels(log: InMemorySource, seed: int, kind: Literal["lost", "wrong", "new"]) -> InMemorySource:
    """A copy in which a third of the place labels are lost, or wrong: those of other places of the recording
    (with a single place none are), or a third of those at places known by then are new: never used before."""
    stream, label = np.random.default_rng(seed), log.label.copy()
    given = np.flatnonzero(label >= 0)
    places, first = np.unique(label[given], return_index=True)
    if kind == "new":
        given = np.setdiff1d(given, given[first])
    chosen = np.sort(stream.permutation(given)[: round(SPOILT_LABELS * len(given))])
    if kind == "lost":
        label[chosen] = -1
    elif kind == "new":
        label[chosen] = label.max(initial=0) + 1 + np.arange(len(chosen))
    elif len(places) > 1:
        others = stream.integers(1, len(places), len(chosen))
        label[chosen] = places[(np.searchsorted(places, label[chosen]) + others) % len(places)]
    return replace(log, digest=f"{log.digest}+{kind} {seed}", label=label)


def _looks(log: InMemorySource) -> np.ndarray:
    """Rows with a view or a place label."""
    return np.flatnonzero(log.seen | (log.label >= 0))


def _draw_start(looks: np.ndarray, stream: np.random.Generator) -> int:
    """The first row of a copy."""
    low, high = START
    return int(looks[min(int(stream.integers(low, high + 1)), len(looks) - 1)]) if len(looks) else 0


def _drop_rows(log: InMemorySource, first: int, share: float, stream: np.random.Generator) -> InMemorySource:
    """The rows from `first` on without a share of those after it that have a view or a place label; each has
    the motion since the remaining row before it."""
    looks = _looks(log)
    keep = np.ones(log.length, bool)
    keep[looks] = stream.random(len(looks)) >= share
    keep[:first] = False
    keep[first] = True
    rows = np.flatnonzero(keep)
    motion, since, at = np.zeros((len(rows), 4)), np.zeros(4), 0
    for row in range(first, log.length):
        since[:3] = compose(since[:3], log.motion[row, :3])
        since[3] += log.motion[row, 3]
        if keep[row]:
            motion[at] = since
            since, at = np.zeros(4), at + 1
    moved = log.moved[rows] | motion[:, :3].any(axis=1)
    return replace(select_rows(log, rows), motion=motion, moved=moved)
