"""The figures of the reproductions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from evaluation.metrics.experience_log import creation_rows
from evaluation.metrics.trajectory import align
from evaluation.plots.paper_figures import (
    DrivenPath,
    ExperienceHistory,
    MeasuredQuantity,
    draw_curves,
    draw_directions,
    draw_drift,
    draw_experiences,
    draw_measured,
)
from ratslam.experiments.salman2016.claims import LABELS, RATIOS, Row, column, series
from ratslam.experiments.salman2016.direction_metrics import clockwise_steps, lap_of_step
from ratslam.experiments.salman2016.protocols import Protocol
from ratslam.experiments.trials.touch_trial import SessionResult, experience_metric_if_defined
from tactile.base.se2 import compose

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIRST_SET_ONLY = ("fig2", "fig3", "fig5")
"""Figures of a session of the first set instead of metrics over all sets."""
SHOWN = ("arr", "arcr", "em")
"""Quantities of a dot plot."""

Sessions = Mapping[tuple[str, str], tuple[str, SessionResult]]
"""By condition and method: the directions of the laps, and the result of the first set's session."""


def draw_reproduction(name: str, protocol: Protocol, rows: Sequence[Row], sessions: Sessions) -> Figure:
    """The figure of a reproduction, from its rows and the sessions of its first set."""
    sets = 1 + max(row.number for row in rows)
    title = f"{name}: {protocol.title}"
    count = f"{sets} set{'s' if sets > 1 else ''}"
    line = f"{protocol.source}  ·  {f'the first of {count}' if name in FIRST_SET_ONLY else count}"
    if name in _OF_SESSIONS:
        return _OF_SESSIONS[name](title, line, sessions)
    return (_curves if protocol.swept else _dots)(title, line, protocol, rows)


def _dots(title: str, line: str, protocol: Protocol, rows: Sequence[Row]) -> Figure:
    names = [condition.name for condition in protocol.conditions]
    labels = {"none": "", "shuffled": ", shuffled", "blank": ", no images"}
    shown = [(m, c) for m, c in series(protocol, rows) if c == "none" or m == "ours"]
    measured = [
        MeasuredQuantity(
            LABELS[quantity],
            {
                method + labels[control]: np.array(
                    [column(rows, name, method, control, quantity) for name in names]
                )
                for method, control in shown
            },
            np.array([protocol.paper.get((name, quantity), np.nan) for name in names]),
            quantity in RATIOS,
        )
        for quantity in SHOWN
    ]
    return draw_measured(title, line, names, measured)


def _curves(title: str, line: str, protocol: Protocol, rows: Sequence[Row]) -> Figure:
    curves: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for condition in protocol.conditions:
        name, noise = condition.name.rsplit(", ", 1)
        these = [row for row in rows if row.control == "sweep" and row.condition == condition.name]
        numbers = sorted({row.number for row in these})
        sets = [[row.values for row in these if row.number == number] for number in numbers]
        if numbers:
            arcr, arr = (np.array([[v[q] for v in values] for values in sets]) for q in ("arcr", "arr"))
            curves.setdefault(noise, {})[name] = (arcr, arr)
    return draw_curves(title, line, curves)


def _drift(title: str, line: str, sessions: Sessions) -> Figure:
    paths: dict[str, DrivenPath] = {}
    for (name, _), (laps, result) in sessions.items():
        odometry = compose(result.truth[0], result.odometry)
        lap = lap_of_step(result.truth, len(laps))
        paths.setdefault(name, DrivenPath(result.truth[:, :2], odometry[:, :2], lap))
    return draw_drift(title, line, paths)


def _history(title: str, line: str, sessions: Sessions) -> Figure:
    return draw_experiences(
        title, line, {method: _experiences(result) for (_, method), (_, result) in sessions.items()}
    )


def _experiences(result: SessionResult) -> ExperienceHistory:
    metric, none = experience_metric_if_defined(result), np.zeros(len(result.place), bool)
    if metric is None:
        return ExperienceHistory(result.place, none, none, none, 0)
    known = result.place >= 0
    counted, right, invalid = none.copy(), none.copy(), none.copy()
    counted[known], right[known] = metric.counted, metric.right
    # An experience is invalid if the last re-localisation before it was wrong.
    last = np.maximum.accumulate(np.where(counted, np.arange(len(counted)), -1))
    wrong = (last >= 0) & ~right[last]
    invalid[known] = wrong[creation_rows(result.place[known])]
    return ExperienceHistory(
        result.place, counted, right, invalid, int(np.flatnonzero(known)[metric.base - 1]) + 1
    )


def _directions(title: str, line: str, sessions: Sessions) -> Figure:
    maps = {}
    for (name, method), (laps, result) in sessions.items():
        position = compose(align(result.trajectory, result.truth), result.trajectory)[:, :2]
        maps[f"{name}, {method}"] = position, clockwise_steps(result.truth, laps)
    order = sorted(maps, key=lambda name: (name.rsplit(", ", 1)[1], list(maps).index(name)))
    return draw_directions(title, line, {name: maps[name] for name in order})


_OF_SESSIONS: dict[str, Callable[[str, str, Sessions], Figure]] = {
    "fig2": _drift,
    "fig3": _history,
    "fig5": _directions,
}
