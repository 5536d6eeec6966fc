"""The figures of the reproductions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
    across, panels = _DRAWN[name](protocol, [one for one in found if one.along == FILTERED])
    many = f"the first of {count}" if name == "fox-fig6" and sets > 1 else count
    line = f"{protocol.source}  ·  {many}  ·  {_EXPLAINED[name]}"
    return draw_grids(f"{name}: {protocol.title}", line, panels, across=across)


def _means(protocol: Protocol, found: Sequence[MapperResult]) -> tuple[int, list[GridPanel]]:
    """A mean map for each mapper, method below method."""
    panels = []
    for method in protocol.methods:
        for mapper in protocol.mappers:
            these = [one for one in found if (one.method, one.mapper) == (method, mapper)]
            error = np.mean([one.values[eq6_column(MAIN_CONVENTION)] for one in these])
            mean = mean_grid([one.grid for one in these])
            panels.append(_panel(mapper, f"{method}, {error:.3f}", these[0])._replace(grid=mean))
    return len(protocol.mappers), panels


def _singles(protocol: Protocol, found: Sequence[MapperResult]) -> tuple[int, list[GridPanel]]:
    """A map for each mapper, set below set, with the paths."""
    panels = []
    for method in protocol.methods:
        for number in sorted({one.number for one in found}):
            for mapper in protocol.mappers:
                which = (method, number, mapper)
                panels += [
                    _with_paths(f"{mapper}, trial {number + 1}", method, one)
                    for one in found
                    if (one.method, one.number, one.mapper) == which
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


_EXPLAINED = {
    "fox-fig4": "below each mapper: how it was filtered, eq. 6 (mean of the trials' errors)",
    "fox-fig5": "below each: how it was filtered, position error (dead reckoning's), m",
    "fox-fig6": "odometry noise, reports; position error (dead reckoning's), m",
}
_DRAWN: dict[str, Callable[[Protocol, Sequence[MapperResult]], tuple[int, list[GridPanel]]]] = {
    "fox-fig4": _means,
    "fox-fig5": _singles,
    "fox-fig6": _worlds,
}
