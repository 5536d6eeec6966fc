"""What a study found: a line for each of its rows, over all seeds."""

from __future__ import annotations

import csv
import io
import json
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ratslam.experiments.studies.metrics import DIRECTIONS, MAIN, MEASURED
from ratslam.experiments.studies.results import Result
from tactile.base.atomic_write import write_text_atomically

SHORT = {
    "energy_all": "EM",
    "exm_arr": "ARR",
    "exm_arcr_strict": "ARCR",
    "ate_final": "ATE m",
    "anytime_late": "late m",
    "map_error": "map error",
    "map_auc": "map AUC",
    "step_time": "step us",
    "step_time_p99": "99 % us",
    "compile_time": "compile s",
    "memory": "MiB",
}
"""Headings of the main quantities."""


class Spread(NamedTuple):
    """A quantity over seeds; None where it cannot be told.

    Attributes:
        seeds: how many have it. mean: of these. sd: standard deviation, of two and more. worst: where it is
            known which way is better.
    """

    seeds: int
    mean: float | None
    sd: float | None
    worst: float | None


class Row(NamedTuple):
    """One configuration of a study.

    Attributes:
        seeds: how many have a result. failed: how many have an error instead. spreads: by quantity.
    """

    row: str
    varied: dict[str, Any]
    seeds: int
    failed: int
    spreads: dict[str, Spread]


def label(row: str, varied: dict[str, Any]) -> str:
    """A row's name and combination, keys without their sections where that is enough."""
    last = [key.rpartition(".")[2] for key in varied]
    names = last if len(set(last)) == len(last) else list(varied)
    parts = [f"{name}={_plain(value)}" for name, value in zip(names, varied.values(), strict=True)]
    return " ".join([row, *parts]).strip() or "as configured"


def rows(results: Sequence[Result]) -> list[Row]:
    """Results put together over seeds, in their order."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        groups.setdefault(json.dumps([result.row, result.varied]), []).append(result)
    return [_row(group) for group in groups.values()]


def spread(values: Sequence[float | None], name: str) -> Spread:
    """Of a quantity's values over seeds."""
    known = [float(value) for value in values if value is not None]
    if not known:
        return Spread(0, None, None, None)
    worst = {"low": max(known), "high": min(known), None: None}[DIRECTIONS.get(name)]
    deviation = statistics.stdev(known) if len(known) > 1 else None
    return Spread(len(known), statistics.fmean(known), deviation, worst)


def table(found: Sequence[Row]) -> str:
    """The main quantities as plain text: mean ± standard deviation (worst)."""
    names = [name for name in MAIN if any(row.spreads[name].seeds for row in found if name in row.spreads)]
    columns = [[SHORT[name], *(_cell(row.spreads.get(name)) for row in found)] for name in names]
    labels = ["", *(label(row.row, row.varied) for row in found)]
    seeds = ["seeds", *(f"{row.seeds}" + (f", {row.failed} failed" if row.failed else "") for row in found)]
    filled = [_filled(labels, "<"), *(_filled(column, ">") for column in [seeds, *columns])]
    return "\n".join("  ".join(cells).rstrip() for cells in zip(*filled, strict=True))


def save(found: Sequence[Row], directory: Path) -> list[Path]:
    """table.csv and table.json, each in one piece."""
    names = list(dict.fromkeys(name for row in found for name in row.spreads))
    keys = list(dict.fromkeys(key for row in found for key in row.varied))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    parts = ("mean", "sd", "worst")
    writer.writerow(
        ["row", *keys, "seeds", "failed", *(f"{name}_{part}" for name in names for part in parts)]
    )
    for row in found:
        spreads = [row.spreads.get(name, Spread(0, None, None, None)) for name in names]
        cells = [getattr(each, part) for each in spreads for part in parts]
        chosen = [_plain(row.varied[key]) if key in row.varied else "" for key in keys]
        exact = ["" if cell is None else repr(cell) for cell in cells]
        writer.writerow([row.row, *chosen, row.seeds, row.failed, *exact])
    content = [
        row._asdict() | {"spreads": {name: each._asdict() for name, each in row.spreads.items()}}
        for row in found
    ]
    paths = [directory / "table.csv", directory / "table.json"]
    write_text_atomically(paths[0], text.getvalue())
    write_text_atomically(paths[1], json.dumps(content, indent=1, allow_nan=False) + "\n")
    return paths


def remarks(results: Sequence[Result], directory: Path) -> list[str]:
    """What a reader of the table should know besides: sentences."""
    told = []
    machines = [result.machine for result in results if result.machine]
    builds, processors = {each.build for each in machines}, {each.processor for each in machines}
    if len(builds) > 1:
        told.append(
            f"the results are of {len(builds)} builds of ratslam; remove {directory} to run all again"
        )
    if len(processors) > 1 or max((each.workers for each in machines), default=1) > 1:
        told.append(
            "times are of several jobs at once, or of several machines: measure speed with --workers 1"
        )
    return told


def _row(group: Sequence[Result]) -> Row:
    fine = [result for result in group if result.error is None]
    names = dict.fromkeys([*(name for result in fine for name in result.quantities), *MEASURED])
    spreads = {name: spread([result.value(name) for result in fine], name) for name in names}
    return Row(group[0].row, group[0].varied, len(fine), len(group) - len(fine), spreads)


def _cell(found: Spread | None) -> str:
    if found is None or found.mean is None:
        return "-"
    text = _number(found.mean)
    if found.sd is not None:
        text += f" ± {_number(found.sd)}"
    return text if found.worst is None or found.seeds == 1 else f"{text} ({_number(found.worst)})"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}" if abs(value) < 0.1 else f"{value:.3g}"


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def _filled(cells: Sequence[str], side: str) -> list[str]:
    width = max(map(len, cells))
    return [f"{cell:{side}{width}}" for cell in cells]
