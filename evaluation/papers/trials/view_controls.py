"""Control conditions: the views of a source replaced, its odometry and truth unchanged.

A method that closes loops on shuffled or blank views does so by odometry alone; ideal views give the upper
bound of the rest of the method.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from robot.sources.in_memory import InMemorySource
from tactile.base.random_streams import stream

Control = Literal["none", "shuffled", "blank", "ideal"]
"""`none`: unchanged; `shuffled`: random order; `blank`: all zero; `ideal`: a distinct view for each spot."""
SPOT = 0.06
"""Side length of a spot with an ideal view, m."""
SECTORS = 8
"""Heading sectors of a spot, each with its own ideal view."""
LIT = 0.5
"""Share of non-zero pixels of an ideal view."""


def apply_control(log: InMemorySource, control: Control, seed: int) -> InMemorySource:
    """The source with replaced views; steps without a view stay without one."""
    if control == "none":
        return log
    views = np.zeros_like(log.views)
    if control == "shuffled":
        rows = np.flatnonzero(log.seen)
        views[rows] = log.views[stream(seed, "control.shuffled").permutation(rows)]
    elif control == "ideal":
        views = _ideal_views(log, seed)
    views = np.where(log.seen[:, None, None, None], views, log.views)
    return replace(log, digest=f"{log.digest}+{control}+{seed}", views=views)


def _ideal_views(log: InMemorySource, seed: int) -> np.ndarray:
    """Random views, one for each pair of spot and heading sector."""
    assert log.truth is not None
    spot = np.round(log.truth[:, :2] / SPOT)
    sector = np.round(log.truth[:, 2] / (2 * np.pi / SECTORS)) % SECTORS
    kinds, row = np.unique(np.column_stack([spot, sector]), axis=0, return_inverse=True)
    random = stream(seed, "control.ideal")
    shape = (len(kinds), *log.view_shape)
    return (random.random(shape) * (random.random(shape) < LIT))[row.reshape(-1)]
