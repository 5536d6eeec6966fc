"""The rows of a study: statistics over seeds and copies, and which rows are Pareto-optimal."""

from __future__ import annotations

import json
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from evaluation.metrics.metric import Direction
from evaluation.metrics.statistics import pareto_optimal
from evaluation.studies.metrics import DEFAULT_ERRORS, MEASURED, METRICS
from evaluation.studies.records import RunRecord

DEAD_RECKONING = "dead reckoning"  # name of the row of raw odometry


@dataclass(frozen=True)
class Spread:
    """Statistics of a quantity over the runs of a row."""

    values: tuple[float | None, ...]  # by run, None where it has none
    mean: float
    sd: float | None  # standard deviation; None of a single value
    median: float
    low: float
    high: float
    worst: float | None  # None where neither high nor low values are better


@dataclass(frozen=True)
class Row:
    """One configuration of a study."""

    row: str  # name
    varied: dict[str, Any]  # combination of the varied settings, by key path
    runs: int  # number of runs with an outcome
    failed: int  # number of the others
    steps: float  # median number of observations
    spreads: dict[str, Spread]  # by quantity, without those that no run has
    optimal: bool = False  # no other row is at least as fast and as good and better in one of both

    @property
    def label(self) -> str:
        """Name and combination."""
        return label(self.row, self.varied)


def label(row: str, varied: dict[str, Any]) -> str:
    """A row's name and combination, with the last part of each key where that is unambiguous."""
    last = [key.rpartition(".")[2] for key in varied]
    names = last if len(set(last)) == len(last) else list(varied)
    parts = [f"{name}={plain(value)}" for name, value in zip(names, varied.values(), strict=True)]
    return " ".join([row, *parts]).strip() or "as configured"


def plain(value: Any) -> str:
    """A setting's value as JSON, a text without quotes."""
    return value if isinstance(value, str) else json.dumps(value)


def summarise(records: Sequence[RunRecord], odometry: bool = False) -> list[Row]:
    """A row for each name and combination, in their order; last that of raw odometry if asked for."""
    groups: dict[str, list[RunRecord]] = {}
    for record in records:
        groups.setdefault(json.dumps([record.row, record.varied]), []).append(record)
    rows = [_row(group) for group in groups.values()]
    if odometry and groups:
        rows.append(_row(next(iter(groups.values())), odometry=True))
    return rows


def default_error(rows: Sequence[Row]) -> str | None:
    """The first default error that most rows have in all of their runs; None if no row has any."""
    whole = [name for row in rows for name, found in row.spreads.items() if None not in found.values]
    best = max(DEFAULT_ERRORS, key=whole.count)
    return best if best in whole else None


def mark_optimal(rows: Sequence[Row], objectives: Mapping[str, Direction], statistic: str) -> list[Row]:
    """The rows with `optimal` set by the mean or median of each objective.

    Only a row whose runs all have all objectives can be optimal.
    """
    costs = np.array([[_cost(row, each, objectives[each], statistic) for each in objectives] for row in rows])
    best = pareto_optimal(costs.reshape(-1, len(objectives)))
    return [replace(row, optimal=bool(each)) for row, each in zip(rows, best, strict=True)]


def spread(values: Sequence[float | None], name: str) -> Spread | None:
    """Statistics of a quantity's values; None if there is no value."""
    known = [float(value) for value in values if value is not None]
    if not known:
        return None
    low, high = min(known), max(known)
    worst = {"low": high, "high": low, None: None}[METRICS[name].direction if name in METRICS else None]
    deviation = statistics.stdev(known) if len(known) > 1 else None
    mean, median = statistics.fmean(known), statistics.median(known)
    return Spread(tuple(values), mean, deviation, median, low, high, worst)


def _row(group: Sequence[RunRecord], odometry: bool = False) -> Row:
    fine = [record for record in group if record.error is None]
    names = dict.fromkeys([metric.name for metric in MEASURED])
    names |= dict.fromkeys(each for record in fine for each in record.quantities)
    spreads = {
        each: spread([run.odometry(each) if odometry else run.value(each) for run in fine], each)
        for each in names
    }
    return Row(
        row=DEAD_RECKONING if odometry else group[0].row,
        varied={} if odometry else group[0].varied,
        runs=len(fine),
        failed=0 if odometry else len(group) - len(fine),
        steps=statistics.median([record.steps for record in fine]) if fine else 0.0,
        spreads={each: found for each, found in spreads.items() if found is not None},
    )


def _cost(row: Row, name: str, direction: Direction, statistic: str) -> float:
    """An objective of a row, low values better; NaN where a run lacks it."""
    found = row.spreads.get(name)
    if row.failed or found is None or None in found.values:
        return np.nan
    value: float = getattr(found, statistic)
    return -value if direction == "high" else value
