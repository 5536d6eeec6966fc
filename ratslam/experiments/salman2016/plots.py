"""The figures of the reproductions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from evaluation.metrics.direction_metrics import clockwise_steps, lap_of_step
from evaluation.metrics.session_metrics import experience_metric_if_defined
from evaluation.metrics.trajectory import align
from evaluation.plots import paper_figures, style
from evaluation.plots.paper_figures import DrivenPath, MeasuredQuantity, experience_history
from ratslam.experiments.salman2016.claims import LABELS, RATIOS, series
from ratslam.experiments.salman2016.protocols import Protocol
from ratslam.experiments.trials.reproduction import ResultRow, column, count_sets
from tactile.base.se2 import compose

Rows = Sequence[ResultRow]


def draw_reproduction(name: str, protocol: Protocol, rows: Rows) -> style.Figure:
    """The figure of a reproduction: metrics over all sets, or sessions of the first set."""
    draw_sessions = {"fig2": _drift, "fig3": _history, "fig5": _directions}.get(name)
    title = f"{name}: {protocol.title}"
    line = f"{protocol.source}  ·  {count_sets(rows, first_only=draw_sessions is not None)}"
    if draw_sessions is not None:
        return draw_sessions(title, line, [row for row in rows if row.session is not None])
    return (_curves if protocol.swept else _dots)(title, line, protocol, rows)


def _dots(title: str, line: str, protocol: Protocol, rows: Rows) -> style.Figure:
    names = [condition.name for condition in protocol.conditions]
    labels = {"none": "", "shuffled": ", shuffled", "blank": ", no images"}
    shown = [(m, c) for m, c in series(protocol, rows) if c == "none" or m == "ours"]
    measured = [
        MeasuredQuantity(
            LABELS[quantity],
            {
                m + labels[c]: np.array([column(rows, (name, m, c), quantity) for name in names])
                for m, c in shown
            },
            np.array([protocol.paper.get((name, quantity), np.nan) for name in names]),
            quantity in RATIOS,
        )
        for quantity in ("arr", "arcr", "em")
    ]
    return paper_figures.draw_measured(title, line, names, measured)


def _curves(title: str, line: str, protocol: Protocol, rows: Rows) -> style.Figure:
    curves: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for condition in protocol.conditions:
        name, noise = condition.name.rsplit(", ", 1)
        these = [row for row in rows if (row.key[0], row.key[2]) == (condition.name, "sweep")]
        numbers = sorted({row.number for row in these})
        sets = [[row.values for row in these if row.number == number] for number in numbers]
        if numbers:
            arcr, arr = (np.array([[v[q] for v in values] for values in sets]) for q in ("arcr", "arr"))
            curves.setdefault(noise, {})[name] = (arcr, arr)
    return paper_figures.draw_curves(title, line, curves)


def _drift(title: str, line: str, rows: Rows) -> style.Figure:
    paths: dict[str, DrivenPath] = {}
    for row in rows:
        laps, result = row.session
        odometry = compose(result.truth[0], result.odometry)
        lap = lap_of_step(result.truth, len(laps))
        paths.setdefault(row.key[0], DrivenPath(result.truth[:, :2], odometry[:, :2], lap))
    return paper_figures.draw_drift(title, line, paths)


def _history(title: str, line: str, rows: Rows) -> style.Figure:
    runs = ((row.key[1], row.session[1]) for row in rows)
    histories = {name: experience_history(run.place, experience_metric_if_defined(run)) for name, run in runs}
    return paper_figures.draw_experiences(title, line, histories)


def _directions(title: str, line: str, rows: Rows) -> style.Figure:
    maps = {}
    for row in sorted(rows, key=lambda row: row.key[1]):
        laps, result = row.session
        position = compose(align(result.trajectory, result.truth), result.trajectory)[:, :2]
        maps[f"{row.key[0]}, {row.key[1]}"] = position, clockwise_steps(result.truth, laps)
    return paper_figures.draw_directions(title, line, maps)
