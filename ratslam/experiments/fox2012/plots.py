"""The figures of the reproductions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from evaluation.metrics.grid_error import MAIN_CONVENTION
from evaluation.metrics.occupancy_grid import mean_grid
from evaluation.plots.grid_plot import GridPanel, GridPaths, draw_grids
from ratslam.experiments.fox2012.metrics import eq6_column
from ratslam.experiments.fox2012.protocols import FILTERED, Protocol
from ratslam.experiments.fox2012.trials import MapperResult
from robot.world.arena import wall_segments

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_reproduction(name: str, protocol: Protocol, found: Sequence[MapperResult]) -> Figure:
    """The figure of a reproduction."""
    sets = len({one.number for one in found})
    count = f"{sets} set{'s' if sets > 1 else ''}"
    draw, explanation = _FIGURES[name]
    across, panels = draw(protocol, [one for one in found if one.along == FILTERED])
    many = f"the first of {count}" if name == "fox-fig6" and sets > 1 else count
    line = f"{protocol.source}  ·  {many}  ·  {explanation}"
    return draw_grids(f"{name}: {protocol.title}", line, panels, across=across)


def _means(protocol: Protocol, found: Sequence[MapperResult]) -> tuple[int, list[GridPanel]]:
    """A mean map for each mapper, method below method."""
    panels = []
    for method, mapper in product(protocol.methods, protocol.mappers):
        these = [one for one in found if (one.method, one.mapper) == (method, mapper)]
        error = np.mean([one.values[eq6_column(MAIN_CONVENTION)] for one in these])
        mean = mean_grid([one.grid for one in these])
        panels.append(_panel(mapper, f"{method}, {error:.3f}", these[0])._replace(grid=mean))
    return len(protocol.mappers), panels


def _singles(protocol: Protocol, found: Sequence[MapperResult]) -> tuple[int, list[GridPanel]]:
    """A map for each mapper, set below set, with the paths."""
    numbers = sorted({one.number for one in found})
    panels = [
        _with_paths(f"{mapper}, trial {number + 1}", method, one)
        for method, number, mapper in product(protocol.methods, numbers, protocol.mappers)
        for one in found
        if (one.method, one.number, one.mapper) == (method, number, mapper)
    ]
    return len(protocol.mappers), panels


def _worlds(protocol: Protocol, found: Sequence[MapperResult]) -> tuple[int, list[GridPanel]]:
    """A map of the first set for each world and length, method below method."""
    panels = [
        _with_paths(f"{one.world}, {one.reports}", method, one)
        for method in protocol.methods
        for one in sorted(found, key=lambda one: (one.world, one.reports))
        if one.method == method and one.number == 0
    ]
    return len(panels) // len(protocol.methods), panels


def _with_paths(name: str, method: str, one: MapperResult) -> GridPanel:
    line = f"{method}, {one.values['online_error']:.3f} ({one.values['odometry_error']:.3f})"
    return _panel(name, line, one)._replace(paths=GridPaths(one.truth, one.online, one.odometry))


def _panel(name: str, line: str, one: MapperResult) -> GridPanel:
    return GridPanel(name, line, one.grid, wall_segments(one.arena))


_FIGURES: dict[str, tuple[Callable[[Protocol, Sequence[MapperResult]], tuple[int, list[GridPanel]]], str]] = {
    "fox-fig4": (_means, "below each mapper: the filter, eq. 6 (mean of the trials' errors)"),
    "fox-fig5": (_singles, "below each: the filter, position error (dead reckoning's), m"),
    "fox-fig6": (_worlds, "odometry noise, reports; position error (dead reckoning's), m"),
}
