"""Columns of pose cells: those of one place on the torus, at headings all the way round."""

from __future__ import annotations

import numpy as np

from ratslam.attractor.config import PoseCellConfig
from tactile.base.random_streams import stream

EVERY = 3
"""Every third heading is recorded: the packet is wider than the gap."""


def choose_columns(config: PoseCellConfig, count: int, seed: int) -> list[list[int]]:
    """Indices [x, y, heading] of the cells of `count` columns, drawn without repeats; a setting
    `cells.chosen`."""
    side = config.cells_xy
    drawn = stream(seed, "cells.columns").permutation(side * side)[:count].tolist()
    headings = range(0, config.cells_heading, EVERY)
    return [[at % side, at // side, heading] for at in drawn for heading in headings]


def sum_columns(activity: np.ndarray, columns: int) -> np.ndarray:
    """[T, columns] activity of columns, from that of their cells [T, C]."""
    return activity.reshape(len(activity), columns, -1).sum(axis=2)


def one_of_each(activity: np.ndarray, columns: int) -> np.ndarray:
    """[T, columns] activity of one cell of each column, at a heading that differs from column to column."""
    split = activity.reshape(len(activity), columns, -1)
    at = np.arange(columns)
    return split[:, at, at % split.shape[2]]
