"""The charts of the page, as figures of plotly.

A trace names its role in `meta`; the page colours roles by `PALETTE`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from typing import Any

import numpy as np

from evaluation.artifacts.run_reader import ACCEPTED
from evaluation.metrics.occupancy_grid import OccupancyGrid
from evaluation.metrics.run_metrics import DOUBTED, bounds
from evaluation.metrics.trajectory import position_errors
from evaluation.plots.map_plot import path_pieces, split_at_jumps, wall_corners
from evaluation.report.run_report import WORDS, RunReport
from tactile.base.se2 import compose, inverse

_DASHES = ("solid", "dash", "dot", "dashdot")
_CLOSURES = {ACCEPTED: ("accepted", "circle", "solid"), "open": ("refused", "x", "dot")}
_OTHER = ("refused", "square-open", "dot")  # verdicts of other names
_MARK, _CROWD = 7.0, 300  # pixels of a closure's mark, and the number above which marks shrink
_DRAWN = 500  # most marks of a kind at a time, evenly chosen from those in view, so that the page opens fast
_ROOM, _MARGIN = 0.15, 0.06  # shares of the map's size: for drifting odometry, and on all sides


def run_charts(report: RunReport) -> dict[str, Any]:
    """The charts of a run by name: `map`, and those of `error`, `doubt`, `belief`, `spread`, `cost` that have
    data."""
    charts = {"map": _map_chart(report), "error": error_chart([report])}
    time = report.run.time - report.run.time[0]
    if np.isfinite(report.doubt).any():
        doubt, name = np.column_stack([time, report.doubt]), "probability worse than odometry"
        limit = np.array([[time[0], DOUBTED], [time[-1], DOUBTED]])
        bound = _line(limit, "limit above which a map is doubted", "limit", dash="dash", width=1.4)
        traces = [_line(doubt, name, "final", width=2), bound]
        charts["doubt"] = _figure(traces, "time, s", "probability")
        charts["doubt"].update_yaxes(range=[-0.02, 1.02])
    elif report.run.truth is None:
        spread = _line(np.column_stack([time, report.spread]), "standard deviation", "final", width=1.6)
        charts["spread"] = _figure([spread], "time, s", "m", zero=True)
    if len(report.belief):
        kinds = (("heaviest packet", "final"), ("second packet", "doubted"), ("new place", "odometry"))
        traces = [
            _line(np.column_stack([time[report.belief_step], share]), name, role, width=1.2)
            for (name, role), share in zip(kinds, report.belief.T, strict=True)
        ]
        charts["belief"] = _figure(traces, "time, s", "probability")
        charts["belief"].update_yaxes(range=[-0.02, 1.02])
    if len(report.cost):
        shown = _line(report.cost * [1, 1e3], "mean of each chunk of steps", "final", width=1.4)
        charts["cost"] = _figure([shown], "step", "ms a step")
        charts["cost"].update_yaxes(type="log", dtick=1)
    return {name: chart for name, chart in charts.items() if chart is not None}


def _map_chart(report: RunReport) -> Any:
    """The map: walls or grid, truth, odometry, final trajectory, experiences with their links, closures."""
    layers, traces = report.layers, []
    corners = wall_corners(report.walls, layers.to_map)
    if report.grid is not None:
        traces.append(_grid_trace(report.grid))
    if len(report.walls):
        wall = _scatter(_gapped(corners), fill="toself", mode="lines", line_width=0)
        traces.append(wall.update(name="wall", meta="wall", hoverinfo="skip"))
    if len(report.truth_lines):
        lines = _gapped(report.truth_lines.reshape(-1, 2, 2))
        traces.append(_line(lines, "walls, true", "ink", width=1.5))
    if layers.truth is not None:
        truth = split_at_jumps(layers.truth, layers.truth)
        traces.append(_line(truth, "truth", "truth", width=5, opacity=0.75))
    traces.append(_line(layers.odometry, "odometry", "odometry", width=1, opacity=0.6))
    if report.map_path is not None:
        traces.append(_line(report.map_path, "map, not believed", "doubted", dash="dot", width=1.2))
    run = report.run
    for rank, name, path in path_pieces(run, layers.final, layers.truth):
        role = f"run{rank % RUN_ROLES}" if rank else "final"
        traces.append(_line(path, name or "trajectory", role, width=1.6))
    main = f"piece {run.main + 1}," if run.has_pieces and not len(run.state) else "the map,"
    traces = [*traces, *_place_traces(report), *_closure_traces(report)]
    box = layers.box(_ROOM, corners, report.truth_lines.reshape(-1, 2))
    figure = _map_figure(traces, box, main)
    # The links, and of each verdict the lines between the two places, in the order of its marks.
    links = layers.nodes[run.links]
    shapes = [_line_shape(links, "link", "solid", "experience")] if len(links) else []
    for verdict, _, ends in _drawn_closures(report):
        shapes.append(_line_shape(ends, *_CLOSURES.get(verdict, _OTHER)[::2], _text(verdict)))
    figure.update_layout(shapes=shapes)
    if report.grid is not None:  # no empty space beside the grid
        figure.update_xaxes(constrain="domain").update_yaxes(constrain="domain")
    return figure


def overlay_chart(reports: Sequence[RunReport]) -> Any:
    """The final trajectories of several runs, each aligned to its truth, over the truth of the first."""
    known = [_as_true(each, each.layers.truth) for each in reports if each.layers.truth is not None][:1]
    paths = [_as_true(report, report.layers.final) for report in reports]
    traces = [_line(split_at_jumps(truth, truth), "truth", "truth", width=5) for truth in known]
    traces += [_line(path, reports[k].name, *_run_style(k)) for k, path in enumerate(paths)]
    box = np.stack(bounds(*paths, *known))
    return _map_figure(traces, box, "the truth, or of the map,")


def _as_true(report: RunReport, points: np.ndarray) -> np.ndarray:
    """Points [n, 2] of a run's layers in the frame of its truth, m."""
    poses = np.column_stack([points, np.zeros(len(points))])
    return compose(inverse(report.layers.to_map), poses)[:, :2]


def error_chart(reports: Sequence[RunReport]) -> Any | None:
    """Position errors against time; of one run also those of odometry and of the current pose; None without
    truth."""
    traces, alone = [], len(reports) == 1
    for number, report in enumerate(reports):
        run, rows = report.run, report.run.truth_rows
        if run.truth is None or len(rows) == 0:
            continue
        time = run.time[rows] - run.time[0]
        final = np.column_stack([time, position_errors(run.final[rows], run.truth[rows])])
        if not alone:
            traces.append(_line(final, report.name, *_run_style(number)))
            continue
        odometry = np.column_stack([time, position_errors(run.odometry[rows], run.truth[rows])])
        traces.append(_line(odometry, "odometry", "odometry", width=1))
        if len(report.online_error) and not run.has_pieces:  # it compares poses of different pieces
            online = report.online_error - [run.time[0], 0.0]
            traces.append(_line(online, "map, as known at the time", "online", dash="dot", width=1.6))
        traces.append(_line(final, "final trajectory", "final", width=2))
    return _figure(traces, "time, s", "position error, m", zero=True) if traces else None


def _place_traces(report: RunReport) -> list[Any]:
    nodes = report.layers.nodes
    if not len(nodes):
        return []
    size = _MARK * min(1.0, np.sqrt(_CROWD / len(nodes))) * 0.75
    marker = {"size": size, "symbol": "circle", "maxdisplayed": _DRAWN}
    hover, name = "experience %{pointNumber}<extra></extra>", "experience, with links"
    places = _scatter(nodes, mode="markers", name=name, meta="place", marker=marker)
    return [places.update(hovertemplate=hover, legendgroup="experience")]


def _closure_traces(report: RunReport) -> list[Any]:
    """Of each verdict the marks halfway between the two places; a mark carries the closure's number."""
    traces, table = [], report.closures
    size = max(4.0, _MARK * min(1.0, np.sqrt(_CROWD / max(1, len(table.steps)))))
    for verdict, rows, ends in _drawn_closures(report):
        role, symbol, _ = _CLOSURES.get(verdict, _OTHER)
        name = f"closure, {_text(WORDS.get(verdict, verdict))} ({len(rows):,})"
        mark = {"size": size, "symbol": symbol, "line": {"width": 1}, "maxdisplayed": _DRAWN}
        mark["opacity"] = 0.35 if role == "refused" else 1
        text = [f"steps {earlier} and {later}" for earlier, later in table.steps[rows].tolist()]
        trace = _scatter(ends.mean(axis=1), mode="markers", name=name, meta=role, marker=mark, text=text)
        trace.update(customdata=rows.astype(np.int32), hovertemplate="%{text}<extra></extra>")
        traces.append(trace.update(legendgroup=_text(verdict)))
    return traces


def _drawn_closures(report: RunReport) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Each verdict, accepted last, with the numbers [k] and ends [k, 2, 2] of its closures in this run."""
    table, path = report.closures, report.map_path if report.map_path is not None else report.layers.final
    inside = ((table.steps >= 0) & (table.steps < len(path))).all(axis=1)
    verdicts = np.array(table.verdicts)
    for verdict in sorted(dict.fromkeys(table.verdicts), key=lambda verdict: verdict == ACCEPTED):
        rows = np.flatnonzero(inside & (verdicts == verdict))
        if len(rows):
            yield verdict, rows, path[table.steps[rows]]


def _line_shape(lines: np.ndarray, role: str, dash: str, group: str) -> dict[str, Any]:
    """Lines [n, 2, 2] as one shape, which is drawn faster than a trace with n gaps."""
    path = "".join(f"M{a:.5g},{b:.5g}L{c:.5g},{d:.5g}" for a, b, c, d in lines.reshape(-1, 4).tolist())
    line = {"width": 1, "dash": dash}
    shape = {"type": "path", "path": path, "name": role, "line": line, "layer": "below"}
    return shape | {"legendgroup": group, "opacity": 0.15 if role == "refused" else 0.6}


def _grid_trace(grid: OccupancyGrid) -> Any:
    from plotly import graph_objects

    percent = np.rint(100 * grid.probability).astype(np.uint8)
    x0, y0 = (grid.origin + grid.cell / 2).tolist()
    return graph_objects.Heatmap(
        z=percent, x0=x0, dx=grid.cell, y0=y0, dy=grid.cell, zmin=0, zmax=100, meta="grid", name="occupancy",
        colorscale=GRID_SCALES["light"],
        hovertemplate="occupied: %{z} %<extra></extra>",
        colorbar={"title": {"text": "occupied, %", "side": "right"}, "thickness": 10, "len": 0.6},
    )  # fmt: skip


def _line(
    points: np.ndarray, name: str, role: str, dash: str = "solid", width: float = 1, opacity: float = 1
):
    """A line through points [n, 2]; NaN rows interrupt it."""
    how = {"mode": "lines", "line": {"width": width, "dash": dash}, "hoverinfo": "skip"}
    return _scatter(points, name=_text(name), meta=role, opacity=opacity, **how)


def _scatter(points: np.ndarray, **how: Any) -> Any:
    """A trace of points [n, 2]; 32 bits are finer than a screen and halve the page."""
    from plotly import graph_objects

    x, y = map(np.ascontiguousarray, np.asarray(points, np.float32).reshape(-1, 2).T)
    return graph_objects.Scatter(x=x, y=y, **how)


def _map_figure(traces: list[Any], box: np.ndarray, of: str) -> Any:
    """A figure with equal scales that shows a box [[left, bottom], [right, top]], m, with a margin."""
    figure = _figure(traces, f"x in the frame of {of} m", f"y in the frame of {of} m")
    figure.update_layout(dragmode="pan")
    margin = max(_MARGIN * (box[1] - box[0]).max(), 1e-3)
    frame = np.stack([box[0] - margin, box[1] + margin])
    figure.update_xaxes(range=frame[:, 0].tolist(), constrain="range")
    figure.update_yaxes(range=frame[:, 1].tolist(), constrain="range", scaleanchor="x", scaleratio=1)
    return figure


def _figure(traces: list[Any], across: str, up: str, zero: bool = False) -> Any:
    from plotly import graph_objects

    figure = graph_objects.Figure(traces)
    legend = {"orientation": "h", "yanchor": "bottom", "y": 1.01, "x": 0, "itemsizing": "trace"}
    figure.update_layout(
        template={}, margin={"l": 56, "r": 12, "t": 12, "b": 44}, legend=legend, hovermode="closest",
        hoverdistance=12, xaxis_title_text=across, yaxis_title_text=up, showlegend=True,
    )  # fmt: skip
    figure.update_xaxes(zeroline=False)
    figure.update_yaxes(zeroline=False, rangemode="tozero" if zero else "normal")
    return figure


def _run_style(number: int) -> tuple[str, str, float]:
    """Role, dash and width of a run's line."""
    return f"run{number % RUN_ROLES}", _DASHES[number % len(_DASHES)], 1.8


def _gapped(lines: np.ndarray) -> np.ndarray:
    """Lines [n, k, 2] as one line of points, interrupted after each."""
    gaps = np.full((len(lines), 1, 2), np.nan)
    return np.concatenate([lines, gaps], axis=1).reshape(-1, 2)


def _text(name: str) -> str:
    """A text as plotly shows it as it is: plotly reads names as HTML."""
    return escape(name, quote=False)


_RUNS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#8a6d00", "#56b4e9")
_RUNS_DARK = ("#5cb3ff", "#ff8c5a", "#3ecf9f", "#e79ac2", "#e0c341", "#a5d8ff")
RUN_ROLES = len(_RUNS)
"""Number of the roles `run0`, `run1` ... of compared runs."""
PALETTE = {
    "light": {
        "text": "#4a4f57", "line": "#e3e5e8", "ground": "#ffffff", "ink": "#14171a",
        "wall": "#c9ccd1", "truth": "#e3b505", "odometry": "#8b9098", "final": "#0072b2",
        "doubted": "#8a5a9e", "place": "#0072b2", "link": "#7fb3d3", "accepted": "#00795a",
        "refused": "#c8500a", "online": "#8a5a9e", "limit": "#c8500a",
        **{f"run{number}": colour for number, colour in enumerate(_RUNS)},
    },
    "dark": {
        "text": "#b4bac3", "line": "#2d333b", "ground": "#15181c", "ink": "#ffffff",
        "wall": "#4a515b", "truth": "#d9b437", "odometry": "#8b939e", "final": "#5cb3ff",
        "doubted": "#c79be0", "place": "#5cb3ff", "link": "#33618a", "accepted": "#3ecf9f",
        "refused": "#ff8c5a", "online": "#c79be0", "limit": "#ff8c5a",
        **{f"run{number}": colour for number, colour in enumerate(_RUNS_DARK)},
    },
}  # fmt: skip
"""The colour of each role in each theme; those of runs are distinguishable with common colour blindness."""
GRID_SCALES = {
    "light": [[0, "#f7f7f5"], [0.5, "#b9bcc1"], [1, "#2a2d31"]],
    "dark": [[0, "#1d2127"], [0.5, "#454c56"], [1, "#eceff2"]],
}
"""The colours of a grid in each theme: free, unknown, occupied."""
