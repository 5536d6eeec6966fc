"""Sums of the activity of all pose cells over bins of the true position and heading."""

from __future__ import annotations

import numpy as np

from evaluation.cells.recording import BinnedSums
from ratslam.pipeline.cell_plan import SumsPlan


class CellSums:
    """Adds the activity of a number of cells, step by step, in memory that does not grow.

    Args:
        began: time from which the first step counts, s.
    """

    def __init__(self, plan: SumsPlan, cells: int, began: float) -> None:
        self._plan, self._until = plan, began
        self._width, self._height = len(plan.x_edges) - 1, len(plan.y_edges) - 1
        self._place = np.zeros((self._height * self._width, cells))
        self._heading = np.zeros((plan.heading_bins, cells))
        self._place_seconds = np.zeros(self._height * self._width)
        self._heading_seconds = np.zeros(plan.heading_bins)

    def add(self, time: float, truth: np.ndarray | None, cell: np.ndarray, activity: np.ndarray) -> None:
        """Adds a step, for the time since the one before.

        Args:
            time: s. truth: [3] true pose. Without one, or outside the bins, the step and its time are left
                out. cell: [n] active cells, where one may come twice. activity: [n] of them.
        """
        elapsed, self._until = time - self._until, time
        at = None if truth is None else self._bins(truth)
        if at is None:
            return
        place, heading = at
        share = elapsed * activity.astype(np.float64)
        np.add.at(self._place[place], cell, share)
        np.add.at(self._heading[heading], cell, share)
        self._place_seconds[place] += elapsed
        self._heading_seconds[heading] += elapsed

    def result(self) -> BinnedSums:
        """The sums so far, float32."""
        plan, grid = self._plan, (self._height, self._width)
        return BinnedSums(
            x_edges=plan.x_edges,
            y_edges=plan.y_edges,
            seconds=self._place_seconds.reshape(grid),
            place=np.ascontiguousarray(self._place.T, np.float32).reshape(-1, *grid),
            heading_seconds=self._heading_seconds,
            heading=np.ascontiguousarray(self._heading.T, np.float32),
        )

    def _bins(self, truth: np.ndarray) -> tuple[int, int] | None:
        """The place bin (row by row) and the heading bin of a true pose, None outside."""
        if not np.isfinite(truth).all():
            return None
        column, row = _bin(self._plan.x_edges, truth[0]), _bin(self._plan.y_edges, truth[1])
        if column is None or row is None:
            return None
        count = self._plan.heading_bins
        return row * self._width + column, round(float(truth[2]) / (2 * np.pi) * count) % count


def _bin(edges: np.ndarray, value: float) -> int | None:
    """The bin between edges [n + 1] that holds a value, None outside; the last one holds its upper edge."""
    if not edges[0] <= value <= edges[-1]:
        return None
    return min(int(np.searchsorted(edges, value, side="right")), len(edges) - 1) - 1
