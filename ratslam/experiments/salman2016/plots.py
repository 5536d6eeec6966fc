"""The picture of each reproduction, from its rows and the sessions of its first set."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from evaluation.metrics.experience_log import creation_rows
from evaluation.metrics.trajectory import align
from evaluation.plots.paper_figures import (
    Experiences,
    Measured,
    Path,
    draw_curves,
    draw_directions,
    draw_drift,
    draw_experiences,
    draw_measured,
)
from ratslam.experiments.salman2016.claims import LABELS, RATIOS, Row, column
from ratslam.experiments.salman2016.direction_metrics import clockwise_steps, lap_of
from ratslam.experiments.salman2016.protocols import METHODS, Protocol
from ratslam.experiments.trials.touch_trial import Played, judged
from tactile.base.se2 import compose

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FIRST = ("fig2", "fig3", "fig5")  # one session is drawn, not figures of all
SHOWN = ("arr", "arcr", "em")
"""Quantities in a picture of dots."""

Sessions = Mapping[tuple[str, str], tuple[str, Played]]
"""By condition and method: the word of the laps, and what the first set's session led to."""


def picture(name: str, protocol: Protocol, rows: Sequence[Row], sessions: Sessions) -> Figure:
    """The figure of a reproduction."""
    sets = 1 + max(row.number for row in rows)
    title = f"{name}: {protocol.title}"
    count = f"{sets} set{'s' if sets > 1 else ''}"
    line = f"{protocol.source}  ·  {f'the first of {count}' if name in _FIRST else count}"
    return _DRAWN.get(name, _dots)(title, line, protocol, rows, sessions)


def _dots(title: str, line: str, protocol: Protocol, rows: Sequence[Row], sessions: Sessions) -> Figure:
    names = [condition.name for condition in protocol.conditions]
    series = [(method, "as felt") for method in METHODS if any(row.method == method for row in rows)]
    if protocol.controls:
        series += [("ours", "shuffled"), ("ours", "blank")]
    labels = {"as felt": "", "shuffled": ", shuffled", "blank": ", no images"}
    measured = [
        Measured(
            LABELS[quantity],
            {
                method + labels[control]: np.array(
                    [column(rows, name, method, control, quantity) for name in names]
                )
                for method, control in series
            },
            np.array([protocol.paper.get((name, quantity), np.nan) for name in names]),
            quantity in RATIOS,
        )
        for quantity in SHOWN
    ]
    return draw_measured(title, line, names, measured)


def _drift(title: str, line: str, protocol: Protocol, rows: Sequence[Row], sessions: Sessions) -> Figure:
    paths = {}
    for condition in protocol.conditions:
        found = [value for (name, _), value in sessions.items() if name == condition.name]
        if found:
            word, result = found[0]
            odometry = compose(result.truth[0], result.odometry)
            paths[condition.name] = Path(
                result.truth[:, :2], odometry[:, :2], lap_of(result.truth, len(word))
            )
    return draw_drift(title, line, paths)


def _history(title: str, line: str, protocol: Protocol, rows: Sequence[Row], sessions: Sessions) -> Figure:
    return draw_experiences(
        title, line, {method: _experiences(result) for (_, method), (_, result) in sessions.items()}
    )


def _experiences(result: Played) -> Experiences:
    metric, none = judged(result), np.zeros(len(result.place), bool)
    if metric is None:
        return Experiences(result.place, none, none, none, 0)
    known = result.place >= 0
    counted, right, invalid = none.copy(), none.copy(), none.copy()
    counted[known], right[known] = metric.counted, metric.right
    # An experience is valid if the last re-localisation before it was correct.
    last = np.maximum.accumulate(np.where(counted, np.arange(len(counted)), -1))
    wrong = (last >= 0) & ~right[last]
    invalid[known] = wrong[creation_rows(result.place[known])]
    return Experiences(result.place, counted, right, invalid, int(np.flatnonzero(known)[metric.base - 1]) + 1)


def _directions(title: str, line: str, protocol: Protocol, rows: Sequence[Row], sessions: Sessions) -> Figure:
    maps = {}
    for (name, method), (word, result) in sessions.items():
        position = compose(align(result.trajectory, result.truth), result.trajectory)[:, :2]
        maps[f"{name}, {method}"] = position, clockwise_steps(result.truth, word)
    order = sorted(maps, key=lambda name: (name.rsplit(", ", 1)[1], list(maps).index(name)))
    return draw_directions(title, line, {name: maps[name] for name in order})


def _curves(title: str, line: str, protocol: Protocol, rows: Sequence[Row], sessions: Sessions) -> Figure:
    curves: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    sweeps = [row for row in rows if row.control == "sweep"]
    for condition in protocol.conditions:
        name, noise = condition.name.rsplit(", ", 1)
        these = [row for row in sweeps if row.condition == condition.name]
        numbers = sorted({row.number for row in these})
        of = [[row.values for row in these if row.number == number] for number in numbers]
        pair = tuple(np.array([[v[q] for v in values] for values in of]) for q in ("arcr", "arr"))
        if numbers:
            curves.setdefault(noise, {})[name] = (pair[0], pair[1])
    return draw_curves(title, line, curves)


_DRAWN: dict[str, Callable[[str, str, Protocol, Sequence[Row], Sessions], Figure]] = {
    "fig2": _drift,
    "fig3": _history,
    "fig5": _directions,
    "matched": _curves,
}
