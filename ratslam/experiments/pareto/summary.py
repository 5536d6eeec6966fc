"""The rows of a study, over seeds, and which of them are Pareto-optimal."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ratslam.experiments.pareto.error_metrics import ErrorOf
from ratslam.experiments.pareto.pareto_front import optimal
from ratslam.experiments.studies.metrics import DIRECTIONS, MEASURED
from ratslam.experiments.studies.results import Result

WHOLE = "run_time"
"""Time per cycle of a whole run: simulating, sensing, the engine, judging, but not compiling, us."""


class Span(NamedTuple):
    """A quantity over seeds.

    Attributes:
        values: by seed, None where it has none. median, low, high: of those there are. worst: the one of the
            ends that is; None where it is not known which way is better.
    """

    values: tuple[float | None, ...]
    median: float
    low: float
    high: float
    worst: float | None


class Line(NamedTuple):
    """One configuration.

    Attributes:
        row, varied: its name and combination, as the study has them. seeds: how many have a result. failed:
            how many have an error instead. cycles: median number of observations. spans: by quantity; those
            that no seed has are missing. error: the one that speed is held against. optimal: no other line
            is both as fast and as good, and better in one of them.
    """

    row: str
    varied: dict[str, Any]
    seeds: int
    failed: int
    cycles: float
    spans: dict[str, Span]
    error: Span | None
    optimal: bool


def grouped(results: Sequence[Result]) -> list[list[Result]]:
    """Results by configuration, in their order."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(json.dumps([result.row, result.varied]), []).append(result)
    return list(groups.values())


def lines(groups: Sequence[Sequence[Result]], error: ErrorOf | None) -> list[Line]:
    """A line for each group. Only one whose seeds all have both, time and error, can be optimal: without the
    seeds that failed it would look better than it is."""
    found = [_line(group, error) for group in groups]
    costs = np.array([_cost(line) for line in found]).reshape(-1, 2)
    return [line._replace(optimal=bool(best)) for line, best in zip(found, optimal(costs), strict=True)]


def span(values: Sequence[float | None], direction: str | None = None) -> Span | None:
    """Over values of seeds; None where no seed has any."""
    known = [float(value) for value in values if value is not None]
    if not known:
        return None
    low, high = min(known), max(known)
    worst = {"low": high, "high": low, None: None}[direction]
    return Span(tuple(values), statistics.median(known), low, high, worst)


def run_time(result: Result) -> float | None:
    """See `WHOLE`."""
    timing = result.timing
    if timing is None or not result.steps:
        return None
    return 1e6 * max(timing.total_s - timing.compile_s, 0.0) / result.steps


def _line(group: Sequence[Result], error: ErrorOf | None) -> Line:
    fine = [result for result in group if result.error is None]
    scored = dict.fromkeys(name for result in fine for name in result.quantities)

    def asked(name: str) -> Callable[[Result], float | None]:
        return lambda result: result.value(name)

    found = {name: span([*map(asked(name), fine)], DIRECTIONS.get(name)) for name in [*MEASURED, *scored]}
    found[WHOLE] = span([*map(run_time, fine)], "low")
    return Line(
        row=group[0].row,
        varied=group[0].varied,
        seeds=len(fine),
        failed=len(group) - len(fine),
        cycles=statistics.median([result.steps for result in fine]) if fine else 0.0,
        spans={name: each for name, each in found.items() if each is not None},
        error=span([error.of(result) for result in fine], "low") if error else None,
        optimal=False,
    )


def _cost(line: Line) -> tuple[float, float]:
    """Time per cycle and error, NaN where anything is missing."""
    time, error = line.spans.get("step_time"), line.error
    if line.failed or time is None or error is None or None in (*time.values, *error.values):
        return np.nan, np.nan
    return time.median, error.median
