"""The recorded activity of pose cells: type and file."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class BinnedSums(NamedTuple):
    """The activity of all cells, summed over time into bins of the true position and heading.

    Attributes:
        x_edges: [W + 1] m. y_edges: [H + 1] m. seconds: [H, W] time in each bin, s. place: [cells, H, W]
            activity times time, s; the mean activity in a bin is `place / seconds`. heading_seconds: [B] time
            at each heading, s; bin b is centred on 2 pi b / B rad. heading: [cells, B] activity times time,
            s. Cells are in the order of the flattened network [K, N, N] over heading, y, x.
    """

    x_edges: np.ndarray
    y_edges: np.ndarray
    seconds: np.ndarray
    place: np.ndarray
    heading_seconds: np.ndarray
    heading: np.ndarray


class CellRecording(NamedTuple):
    """The activity of pose cells over the T steps of a session.

    Attributes:
        shape: (K, N, N) cells of the network over heading, y, x. cell_size: side of a cell, m.
        time: [T] s. truth: [T, 3] true pose, m, m, rad, NaN where unknown. packet: [T, 3] decoded pose over
            x, y, heading, cells. energy: [T] injected by views. place: [T] int32 id of the place or view
            template, -1 for none.
        cell: [C] int32 indices of the chosen cells in the flattened network. activity: [T, C] float32 of the
            chosen cells; the activity of all cells sums to 1.
        sums: of all cells, None if they were not summed.
    """

    shape: tuple[int, int, int]
    cell_size: float
    time: np.ndarray
    truth: np.ndarray
    packet: np.ndarray
    energy: np.ndarray
    place: np.ndarray
    cell: np.ndarray
    activity: np.ndarray
    sums: BinnedSums | None
