"""The rows of a study: statistics over seeds and copies, and which rows are Pareto-optimal."""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ratslam.experiments.studies.metrics import DIRECTIONS, MEASURED, ErrorMetric
from ratslam.experiments.studies.records import RunRecord

DEAD_RECKONING = "dead reckoning"
"""Name of the row of raw odometry."""


class Spread(NamedTuple):
    """Statistics of a quantity over the runs of a row.

    Attributes:
        values: by run, None where it has none. sd: standard deviation; None of a single value. worst: None
            where neither high nor low values are better.
    """

    values: tuple[float | None, ...]
    mean: float
    sd: float | None
    median: float
    low: float
    high: float
    worst: float | None


class Row(NamedTuple):
    """One configuration of a study.

    Attributes:
        row, varied: name and combination. runs: number of runs with an outcome. failed: number of the others.
        steps: median number of observations. spreads: by quantity, without those that no run has. error: of
            the Pareto front. optimal: no other row is at least as fast and as good and better in one of both.
    """

    row: str
    varied: dict[str, Any]
    runs: int
    failed: int
    steps: float
    spreads: dict[str, Spread]
    error: Spread | None = None
    optimal: bool = False


def group_records(records: Sequence[RunRecord]) -> list[list[RunRecord]]:
    """Records by row and combination, in their order."""
    groups: dict[str, list[RunRecord]] = {}
    for record in records:
        groups.setdefault(json.dumps([record.row, record.varied]), []).append(record)
    return list(groups.values())


def summarise(groups: Sequence[Sequence[RunRecord]], error: ErrorMetric | None = None) -> list[Row]:
    """A row for each group. Only a row whose runs all have a time and an error can be optimal."""
    rows = [_row(group, error) for group in groups]
    costs = np.array([_cost(row) for row in rows]).reshape(-1, 2)
    return [row._replace(optimal=bool(best)) for row, best in zip(rows, pareto_optimal(costs), strict=True)]


def odometry_row(group: Sequence[RunRecord]) -> Row:
    """The quantities of raw odometry in a group's sessions, as a row."""
    names = dict.fromkeys(name for record in group for name in record.quantities)
    found = {
        name: spread([each.quantities[name].odometry for each in group if name in each.quantities], name)
        for name in names
    }
    spreads = {name: each for name, each in found.items() if each is not None}
    return Row(DEAD_RECKONING, {}, len(group), 0, group[0].steps if group else 0, spreads)


def spread(values: Sequence[float | None], name: str) -> Spread | None:
    """Statistics of a quantity's values; None if there is no value."""
    known = [float(value) for value in values if value is not None]
    if not known:
        return None
    low, high = min(known), max(known)
    worst = {"low": high, "high": low, None: None}[DIRECTIONS.get(name, "low")]
    deviation = statistics.stdev(known) if len(known) > 1 else None
    middle = statistics.median(known)
    return Spread(tuple(values), statistics.fmean(known), deviation, middle, low, high, worst)


def pareto_optimal(costs: np.ndarray) -> np.ndarray:
    """[N] whether a row of costs [N, K] is Pareto-optimal: no other is at most equal in all and less in one.

    Equal rows are optimal together. A row with a NaN is not optimal and dominates no other.
    """
    known = ~np.isnan(costs).any(axis=1)
    no_dearer = (costs[:, None] <= costs[None]).all(axis=2)
    cheaper = (costs[:, None] < costs[None]).any(axis=2)
    return known & ~(no_dearer & cheaper).any(axis=0)


def _row(group: Sequence[RunRecord], error: ErrorMetric | None) -> Row:
    fine = [record for record in group if record.error is None]
    names = dict.fromkeys([*MEASURED, *(name for record in fine for name in record.quantities)])
    found = {name: spread([record.value(name) for record in fine], name) for name in names}
    return Row(
        row=group[0].row,
        varied=group[0].varied,
        runs=len(fine),
        failed=len(group) - len(fine),
        steps=statistics.median([record.steps for record in fine]) if fine else 0.0,
        spreads={name: each for name, each in found.items() if each is not None},
        error=spread([error.of(record) for record in fine], "error") if error else None,
    )


def _cost(row: Row) -> tuple[float, float]:
    """Time per step and error; NaN where a run lacks one."""
    time, error = row.spreads.get("step_time"), row.error
    if row.failed or time is None or error is None or None in (*time.values, *error.values):
        return np.nan, np.nan
    return time.median, error.median
