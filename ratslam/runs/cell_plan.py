"""What is recorded of the pose cells of a session: settings completed with the network and the source."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.classic.cell_probe import choose_cells
from ratslam.classic.cells_config import CellSumsConfig
from ratslam.core.backend import Backend, PoseCellProbe
from ratslam.core.session import Probe
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.simulated import SimulatedSource
from robot.sources.source import Source
from robot.touch_source import TouchSource
from tactile.base.errors import InputError

LARGEST_SUMS = 2**31
"""Most memory for sums, bytes."""


class SumsPlan(NamedTuple):
    """Sums of all cells: edges of the place bins [W + 1] and [H + 1], m, number of heading bins, and steps
    between two summed ones."""

    x_edges: np.ndarray
    y_edges: np.ndarray
    heading_bins: int
    interval: int


class RecordingPlan(NamedTuple):
    """cells: of the method. cell: [C] int32 chosen cells in the flattened network. sums: None without
    sums."""

    cells: PoseCellProbe
    cell: np.ndarray
    sums: SumsPlan | None


def plan_recording(config: RunConfig, source: Source, backend: Backend) -> RecordingPlan | None:
    """The plan for a completed configuration, its source and its method; None: nothing is recorded.

    Raises:
        InputError: the method has no pose cells, the network not the chosen ones, the extent of the place
            bins is not known, or the sums need too much memory.
    """
    if config.cells is None:
        return None
    cells = backend.probe()
    if cells is None:
        found = f"`backend: {config.backend}`, a method without pose cells"
        raise InputError("cells", found, "`backend: recall` or `backend: classic`", "or remove `cells`")
    sums = config.cells.sums
    plan = RecordingPlan(cells, choose_cells(config.cells.chosen, cells.shape, config.session.seed), None)
    return plan if sums is None else plan._replace(sums=_plan_sums(sums, cells, source))


def probe_of(plan: RecordingPlan) -> Probe:
    """The probe of a session: its steps have the activity of the chosen cells [C], float32, and where all
    cells are summed what was held of them."""
    each = lambda state: plan.cells.each(state, plan.cell)  # noqa: E731
    return Probe(each) if plan.sums is None else Probe(each, plan.cells.hold, plan.sums.interval)


def _plan_sums(sums: CellSumsConfig, cells: PoseCellProbe, source: Source) -> SumsPlan:
    size = 8 * int(np.prod(cells.shape)) * (sums.bins**2 + sums.heading_bins)
    if size > LARGEST_SUMS:
        found = f"sums of {np.prod(cells.shape)} cells, which need {size / 2**30:.1f} GiB"
        raise InputError(
            "cells.sums", found, f"at most {LARGEST_SUMS >> 30} GiB", "choose fewer bins or a smaller network"
        )
    extent = _true_extent(source, cells.cell_size) if sums.extent is None else sums.extent
    if extent is None:
        found = f"missing, and {source.name} does not tell its true path before the run"
        raise InputError("cells.sums.extent", found, "[x0, y0, x1, y1] of the binned rectangle, m")
    x0, y0, x1, y1 = extent
    x_edges, y_edges = np.linspace(x0, x1, sums.bins + 1), np.linspace(y0, y1, sums.bins + 1)
    return SumsPlan(x_edges, y_edges, sums.heading_bins, max(1, round(source.rate_hz / sums.rate)))


def _true_extent(source: Source, least: float) -> tuple[float, float, float, float] | None:
    """The rectangle round the true positions, with sides of at least `least`, m."""
    while isinstance(source, TouchSource):
        source = source.source
    if not isinstance(source, InMemorySource | SimulatedSource) or source.truth is None:
        return None
    at = source.truth[:, :2]
    at = at[np.isfinite(at).all(axis=1)]
    if not len(at):
        return None
    (x0, y0), (x1, y1) = at.min(axis=0).tolist(), at.max(axis=0).tolist()
    return x0, y0, max(x1, x0 + least), max(y1, y0 + least)
