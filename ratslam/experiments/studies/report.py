"""The table of a study as text, Markdown, CSV and JSON, and its picture of speed against error."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from evaluation.plots.pareto_plot import ParetoPoint, draw_pareto
from ratslam.experiments.studies.metrics import COLUMNS, HEADINGS, ErrorMetric, default_error
from ratslam.experiments.studies.records import Machine, RunRecord
from ratslam.experiments.studies.schema import StudyPlan
from ratslam.experiments.studies.summary import Row, Spread, group_records, odometry_row, summarise
from tactile.base.atomic_write import write_atomically, write_text_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DISTURBED = 0.3
"""Load of other processes from which a measurement of speed counts as disturbed, cores."""
KEPT = 1.25
"""Largest final ATE of a row that counts as kept, relative to the first row's."""
PACES = {"live": "one step at a time", "replay": "a chunk of steps at a time"}


class Report(NamedTuple):
    """The outcome of a study.

    Attributes:
        name: of the study. kind: of the table, a key of `COLUMNS`. rows: in order. error: of the Pareto
            front. measured: machine, versions, build, seeds and pace, by name. remarks: sentences.
    """

    name: str
    kind: str
    rows: Sequence[Row]
    error: ErrorMetric | None
    measured: dict[str, str]
    remarks: Sequence[str]


def make_report(
    name: str, plan: StudyPlan, records: Sequence[RunRecord], error: ErrorMetric | None = None
) -> Report:
    """The report of a study's records.

    Args:
        error: of the Pareto front; None: the first default error that most rows have.
    """
    groups = group_records(records)
    if plan.report == "pareto":
        error = error or default_error([[each for each in group if each.error is None] for group in groups])
    rows = summarise(groups, error if plan.report == "pareto" else None)
    if plan.report in ("medians", "differences") and groups:
        fine = [record for record in groups[0] if record.error is None]
        rows.append(odometry_row(fine))
    remarks = [*_remarks(records), *(_kept(rows, plan.limit) if plan.report == "differences" else ())]
    return Report(name, plan.report, rows, error, _measured(records, plan.pace), remarks)


def label(row: str, varied: dict[str, Any]) -> str:
    """A row's name and combination, with the last part of each key where that is unambiguous."""
    last = [key.rpartition(".")[2] for key in varied]
    names = last if len(set(last)) == len(last) else list(varied)
    parts = [f"{name}={_plain(value)}" for name, value in zip(names, varied.values(), strict=True)]
    return " ".join([row, *parts]).strip() or "as configured"


def render_text(report: Report) -> str:
    """The table and its notes as plain text; `*` marks Pareto-optimal rows."""
    pareto = report.kind == "pareto"
    cells = _cells(report, "* {}" if pareto else "{}", "  {}" if pareto else "{}")
    return "\n".join([align(cells), "", *_notes(report, "* ")])


def render_markdown(report: Report) -> str:
    """The table and its notes as Markdown; Pareto-optimal rows are bold."""
    head, *rows = _cells(report, "**{}**", "{}")
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([table, "", *_notes(report, "Bold: ")]) + "\n"


def draw(report: Report) -> Figure | None:
    """Time per step against error; None where no row has both."""
    marks = [
        ParetoPoint(label(row.row, row.varied), _ends(time), _ends(row.error), row.optimal)
        for row in report.rows
        if (time := row.spreads.get("step_time")) is not None and row.error is not None
    ]
    if report.error is None or not marks:
        return None
    below = "  ·  ".join(report.measured[name] for name in ("machine", "seeds", "build"))
    title = f"Speed against error: {report.name}"
    return draw_pareto(title, below, marks, "time per step (us), median", report.error.label)


def save_report(report: Report, directory: Path) -> list[Path]:
    """Writes table.csv, table.json and table.md, and pareto.png where there is something to draw."""
    paths = [directory / f"table.{kind}" for kind in ("csv", "json", "md")]
    for path, content in zip(paths, (_csv(report), _json(report), render_markdown(report)), strict=True):
        write_text_atomically(path, content)
    picture, figure = directory / "pareto.png", draw(report)
    if figure is None:
        picture.unlink(missing_ok=True)  # of an earlier call
        return paths
    write_atomically(picture, figure.savefig)
    return [*paths, picture]


def number(value: float | None) -> str:
    """A value with three significant digits; `-` for None."""
    if value is None:
        return "-"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}" if abs(value) < 0.1 else f"{value:.3g}"


def align(rows: Sequence[Sequence[str]], sides: str = "") -> str:
    """Rows of cells as lines with aligned columns.

    Args:
        sides: `<` or `>` for each column; default: the first to the left, the others to the right.
    """
    columns = list(zip(*rows, strict=True))
    sides = sides or "<" + ">" * (len(columns) - 1)
    widths = [max(map(len, column)) for column in columns]
    lines = (
        "  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(row, sides, widths, strict=True))
        for row in rows
    )
    return "\n".join(line.rstrip() for line in lines)


def _cells(report: Report, best: str, other: str) -> list[list[str]]:
    """Headings and rows; `best` and `other` are the formats of optimal and other names."""
    names = [name for name in COLUMNS[report.kind] if any(name in row.spreads for row in report.rows)]
    shown = report.error is None or report.error.quantity in names
    own = [] if shown or report.error is None else [report.error.name]
    table = [[other.format(""), "runs", "steps", *(HEADINGS[name] for name in names), *own]]
    for row in report.rows:
        name = (best if row.optimal else other).format(label(row.row, row.varied))
        runs = f"{row.runs}" + (f", {row.failed} failed" if row.failed else "")
        base = report.rows[0] if report.kind == "differences" and row is not report.rows[0] else None
        cells = [_cell(row.spreads.get(each), report.kind, base and base.spreads.get(each)) for each in names]
        table.append(
            [name, runs, f"{row.steps:.0f}", *cells, *([_cell(row.error, report.kind)] if own else [])]
        )
    return table


def _cell(found: Spread | None, kind: str, base: Spread | None = None) -> str:
    if found is None:
        return "-"
    several = sum(value is not None for value in found.values) > 1
    text = number(found.mean if kind == "means" else found.median)
    if kind == "means" and found.sd is not None:
        text += f" ± {number(found.sd)}"
    if several and found.worst is not None:
        text += f" ({number(found.worst)})"
    if base is not None:
        change = found.median - base.median
        share = change / base.median if base.median else math.nan
        text += " =" if not change else f" {share:+.0%}" if math.isfinite(share) else f" {change:+.3g}"
    return text


def _notes(report: Report, mark: str) -> list[str]:
    kinds = {
        "means": "Means ± standard deviation over runs (worst).",
        "differences": "Medians over runs (worst), and the difference from the first row.",
    }
    notes = [kinds.get(report.kind, "Medians over runs (worst).")]
    if report.kind == "pareto":
        optimal = "No row has an error to compare its speed with."
        if report.error is not None:
            optimal = f"{mark}no other row is at least as fast and as good by the {report.error.label}."
        notes[0] += f" {optimal}"
        notes.append(
            "Whole run: simulation, sensing and scoring included, us a step. The first run of a row compiles "
            "(worst), others fetch what they share."
        )
    notes.append(f"{'; '.join(report.measured.values())}.")
    return [*notes, *(f"{remark[0].upper()}{remark[1:]}." for remark in report.remarks)]


def _measured(records: Sequence[RunRecord], pace: str) -> dict[str, str]:
    """The conditions of a measurement of speed, by name."""
    machines = [record.machine for record in records if record.machine]
    seeds = len({record.seed for record in records})

    def every(what: Callable[[Machine], str]) -> str:
        return " and ".join(dict.fromkeys(map(what, machines))) or "unknown"

    return {
        "machine": every(_machine_text),
        "versions": every(lambda each: ", ".join(f"{name} {value}" for name, value in each.versions.items())),
        "build": f"build {every(lambda each: each.build)}",
        "seeds": f"{seeds} seed{'s' if seeds != 1 else ''}",
        "pace": PACES[pace],
    }


def _machine_text(machine: Machine) -> str:
    if machine.device != "cpu":
        return f"{machine.processor}, {machine.device}"
    at_once = "one run at a time" if machine.workers == 1 else f"{machine.workers} runs at a time"
    return f"{machine.processor}, {os.cpu_count()} cores, {at_once}"


def _remarks(records: Sequence[RunRecord]) -> list[str]:
    """What impairs a comparison of the records: sentences."""
    machines = [record.machine for record in records if record.machine]
    builds, processors = {each.build for each in machines}, {each.processor for each in machines}
    found = []
    if len(builds) > 1:
        found.append(f"the records are of {len(builds)} builds of ratslam; delete them to run all again")
    if len(processors) > 1 or max((each.workers for each in machines), default=1) > 1:
        found.append(
            "several runs at a time, or several machines, disturb times: measure speed with --workers 1"
        )
    load = max((each.other_load or 0.0 for each in machines if each.workers == 1), default=0.0)
    if load > DISTURBED:
        found.append(f"other processes kept up to {load:.1f} cores busy meanwhile, which lengthens times")
    return found


def _kept(rows: Sequence[Row], limit: float | None) -> list[str]:
    """The share of rows after the first whose final error stays within a limit."""
    others = rows[1:-1]
    base = rows[0].spreads.get("ate_final") if rows else None
    if base is None or not others:
        return ["without true poses there is no error to compare"] if others else []
    most = KEPT * base.high if limit is None else limit
    finals = [row.spreads.get("ate_final") for row in others]
    kept = sum(final is not None and final.high <= most for final in finals)
    return [f"{kept} of {len(others)} rows ({kept / len(others):.0%}) end at an ATE of {most:.3g} m or less"]


def _ends(found: Spread) -> tuple[float, float, float]:
    return found.low, found.median, found.high


def _csv(report: Report) -> str:
    names = list(dict.fromkeys(name for row in report.rows for name in row.spreads))
    keys = list(dict.fromkeys(key for row in report.rows for key in row.varied))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    parts = ("mean", "sd", "median", "low", "high", "worst")
    heads = [f"{name}_{part}" for name in ["error", *names] for part in parts]
    writer.writerow(["row", *keys, "runs", "failed", "steps", "optimal", *heads])
    for row in report.rows:
        spreads = [row.error, *(row.spreads.get(name) for name in names)]
        cells = [getattr(each, part) if each else None for each in spreads for part in parts]
        chosen = [_plain(row.varied[key]) if key in row.varied else "" for key in keys]
        start = [row.row, *chosen, row.runs, row.failed, row.steps, int(row.optimal)]
        writer.writerow([*start, *("" if cell is None else repr(cell) for cell in cells)])
    return text.getvalue()


def _json(report: Report) -> str:
    rows = [
        row._asdict()
        | {"spreads": {name: each._asdict() for name, each in row.spreads.items()}}
        | {"error": row.error and row.error._asdict()}
        for row in report.rows
    ]
    error = report.error and {"name": report.error.name, "label": report.error.label}
    content = report._asdict() | {"rows": rows, "error": error, "remarks": list(report.remarks)}
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
