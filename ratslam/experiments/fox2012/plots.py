"""The figures of the reproductions."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from evaluation.metrics.grid_error import MAIN_CONVENTION
from evaluation.metrics.occupancy_grid import mean_grid
from evaluation.plots import style
from evaluation.plots.grid_plot import GridPanel, GridPaths, draw_grids
from ratslam.experiments.fox2012.protocols import FILTERED, Protocol
from ratslam.experiments.trials.reproduction import ResultRow, count_sets
from robot.world.arena import wall_segments

Rows = Sequence[ResultRow]


def draw_reproduction(name: str, protocol: Protocol, rows: Rows) -> style.Figure:
    """The figure of a reproduction."""
    draw, explanation = {
        "fox-fig4": (_means, "below each mapper: the filter, eq. 6 (mean of the trials' errors)"),
        "fox-fig5": (_singles, "below each: the filter, position error (dead reckoning's), m"),
        "fox-fig6": (_worlds, "odometry noise, reports; position error (dead reckoning's), m"),
    }[name]
    panels, lines = draw(protocol, [row for row in rows if row.key[3] == FILTERED])
    first_only = name == "fox-fig6" and any(row.number for row in rows)
    line = f"{protocol.source}  ·  {count_sets(rows, first_only)}  ·  {explanation}"
    return draw_grids(f"{name}: {protocol.title}", line, panels, across=len(panels) // lines)


def _means(protocol: Protocol, rows: Rows) -> tuple[list[GridPanel], int]:
    """A mean map for each mapper, and the number of lines: method below method."""
    panels = []
    for method, mapper in product(protocol.methods, protocol.mappers):
        these = [row for row in rows if row.key[1:3] == (method, mapper)]
        error = np.mean([row.values[MAIN_CONVENTION.column] for row in these])
        mean = mean_grid([row.session.grid for row in these])
        panels.append(_panel(mapper, f"{method}, {error:.3f}", these[0])._replace(grid=mean))
    return panels, len(protocol.methods)


def _singles(protocol: Protocol, rows: Rows) -> tuple[list[GridPanel], int]:
    """A map with the paths for each mapper, and the number of lines: method below method, set below set."""
    method, mapper = protocol.methods.index, protocol.mappers.index
    rows = sorted(rows, key=lambda row: (method(row.key[1]), row.number, mapper(row.key[2])))
    panels = [_with_paths(f"{row.key[2]}, trial {row.number + 1}", row) for row in rows]
    return panels, len(panels) // len(protocol.mappers)


def _worlds(protocol: Protocol, rows: Rows) -> tuple[list[GridPanel], int]:
    """A map of the first set for each world and length, and the number of lines: method below method."""
    first = [row for row in rows if row.number == 0]
    first.sort(key=lambda row: (protocol.methods.index(row.key[1]), row.key[0], row.values["reports"]))
    panels = [_with_paths(f"{row.key[0]}, {row.values['reports']}", row) for row in first]
    return panels, len(protocol.methods)


def _with_paths(name: str, row: ResultRow) -> GridPanel:
    line = f"{row.key[1]}, {row.values['online_error']:.3f} ({row.values['odometry_error']:.3f})"
    paths = GridPaths(row.session.truth, row.session.online, row.session.odometry)
    return _panel(name, line, row)._replace(paths=paths)


def _panel(name: str, line: str, row: ResultRow) -> GridPanel:
    return GridPanel(name, line, row.session.grid, wall_segments(row.session.arena))
