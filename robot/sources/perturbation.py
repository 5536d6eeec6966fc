"""The same recording a little different: what a result must not hang on.

Another start, other noise, dropped frames: a map that is good on one recording and bad on its perturbed
copies was lucky. All randomness follows from one seed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from robot.sources.in_memory import InMemorySource
from tactile.base.se2 import compose

VIEW_NOISE = 0.01
"""Standard deviation added to every value of a view."""
LENGTH_NOISE = 0.02
"""Of every motion, as a share of it."""
TURN_NOISE = 0.01
"""Of the turn between two views, rad."""
START = (10, 80)
"""Views left out at the start, at least and at most."""
DROPPED = 0.05
"""Share of the views that are dropped."""
NEW_IDS, WRONG_IDS = 0.1, 0.05
"""Shares of given ids that are made new, and replaced by another frame's."""


def perturb(log: InMemorySource, seed: int) -> InMemorySource:
    """A perturbed copy; the digest is the original's with the seed behind it.

    Rows whose view is dropped go; their motion is added to the next row's, so the path stays whole.
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
    label = _wrong(log.label, stream)

    dropped = np.zeros(len(motion), bool)
    dropped[looks] = stream.random(len(looks)) < DROPPED
    keep = ~dropped
    keep[:first] = False
    keep[first] = True
    rows = np.flatnonzero(keep)
    motion = _merged(motion, rows, first)
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


def _wrong(label: np.ndarray, stream: np.random.Generator) -> np.ndarray:
    """Ids [N] of which some are new and some another frame's."""
    given = np.flatnonzero(label >= 0)
    label, chance = label.copy(), stream.random(len(given))
    new, wrong = given[chance < NEW_IDS], given[(chance >= NEW_IDS) & (chance < NEW_IDS + WRONG_IDS)]
    label[wrong] = stream.permutation(label[given])[: len(wrong)]
    label[new] = label.max(initial=0) + 1 + np.arange(len(new))
    return label


def _merged(motion: np.ndarray, rows: np.ndarray, first: int) -> np.ndarray:
    """Motions [M, 4] into the rows that are kept, those of left-out rows in between composed into them."""
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
