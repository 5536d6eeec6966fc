"""Perturbed copies of a recording, to test the robustness of results.

A copy has another start, additional noise, dropped views and wrong place labels, all drawn from one seed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot.sources.in_memory import InMemorySource
from tactile.base.se2 import compose

VIEW_NOISE = 0.01
"""Standard deviation of the noise added to view values."""
LENGTH_NOISE = 0.02
"""Standard deviation of the scale of each forward motion."""
TURN_NOISE = 0.01
"""Standard deviation added to the turn between two views, rad."""
START = (10, 80)
"""Smallest and largest number of views left out at the start."""
DROPPED = 0.05
"""Fraction of views that are dropped."""
NEW_IDS, WRONG_IDS = 0.1, 0.05
"""Fractions of given place labels replaced by new labels, and by labels of other rows."""


def perturb(log: InMemorySource, seed: int) -> InMemorySource:
    """A perturbed copy; its digest is that of the original followed by the seed.

    Rows with a dropped view are removed and their motion is added to the next row, so the path is complete.
    """
    stream = np.random.default_rng(seed)
    looks = np.flatnonzero(log.seen | (log.label >= 0))
    low, high = START
    first = looks[min(int(stream.integers(low, high + 1)), len(looks) - 1)] if len(looks) else 0
    between = max(float(np.diff(looks).mean()), 1.0) if len(looks) > 1 else 1.0

    motion = log.motion.copy()
    motion[:, :2] *= 1 + LENGTH_NOISE * stream.standard_normal((len(motion), 1))
    moving = log.motion[:, :3].any(axis=1)
    motion[:, 2] += moving * TURN_NOISE / np.sqrt(between) * stream.standard_normal(len(motion))
    noise = VIEW_NOISE * stream.standard_normal(log.views.shape)
    views = np.where(log.seen[:, None, None, None], np.clip(log.views + noise, 0, 1), log.views)
    label = corrupt_labels(log.label, stream)

    dropped = np.zeros(len(motion), bool)
    dropped[looks] = stream.random(len(looks)) < DROPPED
    keep = ~dropped
    keep[:first] = False
    keep[first] = True
    rows = np.flatnonzero(keep)
    motion = _merge_motions(motion, rows, first)
    return replace(
        log,
        digest=f"{log.digest}+{seed}",
        time=log.time[rows],
        motion=motion,
        moved=log.moved[rows] | motion[:, :3].any(axis=1),
        views=views[rows],
        seen=log.seen[rows],
        label=label[rows],
        truth=None if log.truth is None else log.truth[rows],
    )


def corrupt_labels(label: np.ndarray, stream: np.random.Generator) -> np.ndarray:
    """Labels [N], some replaced by new labels and some by labels of other rows."""
    given = np.flatnonzero(label >= 0)
    label, chance = label.copy(), stream.random(len(given))
    new, wrong = given[chance < NEW_IDS], given[(chance >= NEW_IDS) & (chance < NEW_IDS + WRONG_IDS)]
    label[wrong] = stream.permutation(label[given])[: len(wrong)]
    label[new] = label.max(initial=0) + 1 + np.arange(len(new))
    return label


def _merge_motions(motion: np.ndarray, rows: np.ndarray, first: int) -> np.ndarray:
    """Motions [M, 4] between the remaining rows, composed of all motions in between."""
    merged = np.zeros((len(rows), 4))
    at = 0
    since = np.zeros(4)
    for row in range(first, len(motion)):
        since[:3] = compose(since[:3], motion[row, :3])
        since[3] += motion[row, 3]
        if at < len(rows) and rows[at] == row:
            merged[at] = since
            since = np.zeros(4)
            at += 1
    return merged
