"""What is done to a session's views to see how much of a result is owed to them.

Odometry and truth stay as they are. A map that closes loops on shuffled or blank views does so by its
odometry alone; ideal views show what the rest can do at best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from robot.sources.in_memory import Log
from tactile.base.random_streams import stream

Control = Literal["as felt", "shuffled", "blank", "ideal"]
"""`shuffled`: the views in another order; `blank`: nothing was ever felt; `ideal`: a view for each spot."""
SPOT = 0.06
"""Side of a spot that has an ideal view of its own, m."""
SECTORS = 8
"""Headings that each have one there: 45 degrees."""
LIT = 0.5
"""Share of the pixels of an ideal view that are not black."""


def controlled(log: Log, control: Control, seed: int) -> Log:
    """The session with its views so changed; those never seen stay unseen."""
    if control == "as felt":
        return log
    views = np.where(log.seen[:, None, None, None], _VIEWS[control](log, seed), log.views)
    return replace(log, digest=f"{log.digest}+{control}+{seed}", views=views)


def _shuffled(log: Log, seed: int) -> np.ndarray:
    rows, views = np.flatnonzero(log.seen), log.views.copy()
    views[rows] = log.views[stream(seed, "control.shuffled").permutation(rows)]
    return views


def _blank(log: Log, seed: int) -> np.ndarray:
    return np.zeros_like(log.views)


def _ideal(log: Log, seed: int) -> np.ndarray:
    """Views that nothing but the spot and the sector decide."""
    assert log.truth is not None
    spot = np.round(log.truth[:, :2] / SPOT)
    sector = np.round(log.truth[:, 2] / (2 * np.pi / SECTORS)) % SECTORS
    kinds, row = np.unique(np.column_stack([spot, sector]), axis=0, return_inverse=True)
    random = stream(seed, "control.ideal")
    shape = (len(kinds), *log.view_shape)
    return (random.random(shape) * (random.random(shape) < LIT))[row.reshape(-1)]


_VIEWS: dict[str, Callable[[Log, int], np.ndarray]] = {
    "shuffled": _shuffled,
    "blank": _blank,
    "ideal": _ideal,
}
