"""The table of a study as text, Markdown, CSV and JSON, and its picture of speed against error."""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from evaluation.studies.machine import Machine
from evaluation.studies.metrics import COLUMNS, METRICS
from evaluation.studies.pareto_plot import ParetoPoint, draw_pareto
from evaluation.studies.records import RunRecord
from evaluation.studies.schema import StudyPlan
from evaluation.studies.study_summary import Row, Spread, default_error, mark_optimal, plain, summarise
from tactile.base.atomic_write import write_atomically, write_text_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DISTURBED = 0.3  # load of other processes from which a measurement of speed counts as disturbed, cores
KEPT = 1.25  # largest final ATE of a row that counts as kept, relative to the first row's
MEANS = ("means", "search")  # kinds of report that show means; others show medians
COMPARED = ("differences", "costs")  # kinds of report that show the difference of each row from the first
PACES = {"live": "one step at a time", "replay": "a chunk of steps at a time"}


@dataclass(frozen=True)
class Report:
    """The outcome of a study."""

    name: str  # of the study
    kind: str  # of the table
    columns: Sequence[str]  # quantities shown
    rows: Sequence[Row]
    error: str | None  # quantity of the Pareto front
    measured: dict[str, str]  # machine, versions, build, seeds and pace, by name
    remarks: Sequence[str]  # sentences


def make_report(
    name: str, plan: StudyPlan, records: Sequence[RunRecord], error: str | None = None, search: bool = False
) -> Report:
    """The report of a study's records.

    Args:
        error: quantity of the Pareto front; None: the first default error that most rows have. search:
            whether the records are of the trials of a search; then the Pareto-optimal ones are marked.
    """
    kind = "search" if search else plan.report
    rows = summarise(records, odometry=kind in ("medians", "differences"))
    error = (error or default_error(rows)) if kind == "pareto" else None
    columns, remarks = [*COLUMNS.get(kind, ()), *([error] if error else [])], list[str]()
    if error is not None:
        rows = mark_optimal(rows, {"step_time": "low", error: METRICS[error].direction}, "median")
    if search and plan.tune is not None:
        columns, rows = [*plan.tune.directions()], mark_optimal(rows, plan.tune.directions(), "mean")
        best, failed = sum(row.optimal for row in rows), sum(bool(row.failed) for row in rows)
        remarks = [f"{len(rows)} trials, {best} of them Pareto-optimal, {failed} failed"]
    if kind == "differences":
        remarks = _kept(rows, plan.limit)
    machines = [record.machine for record in records if record.machine]
    seeds = len({record.seed for record in records})
    measured = describe_machines(machines, seeds) | {"pace": PACES[plan.pace]}
    columns = list(dict.fromkeys(columns))
    return Report(name, kind, columns, rows, error, measured, [*remarks, *find_disturbances(machines)])


def render(report: Report) -> str:
    """The table and its notes as Markdown; Pareto-optimal rows are bold. Of a search only those are shown."""
    names = [name for name in report.columns if any(name in row.spreads for row in report.rows)]
    table = [["", "runs", "steps", *(f"{name} {METRICS[name].unit}".strip() for name in names)]]
    for row in report.rows:
        if report.kind == "search" and not row.optimal:
            continue
        runs = f"{row.runs}" + (f", {row.failed} failed" if row.failed else "")
        base = report.rows[0] if report.kind in COMPARED and row is not report.rows[0] else None
        first = base.spreads if base else {}
        cells = [_cell(row.spreads.get(each), report.kind, first.get(each)) for each in names]
        name = f"**{row.label}**" if row.optimal else row.label
        table.append([name, runs, f"{row.steps:.0f}", *cells])
    remarks = (f"{remark[0].upper()}{remark[1:]}." for remark in report.remarks)
    return "\n".join([render_table(table), "", _note(report), *remarks])


def render_table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells as a Markdown table with aligned columns: the first to the left, others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    rule = [f"{'-' * (widths[0] or 1)}", *("-" * (width - 1) + ":" for width in widths[1:])]
    head, *others = [[f"{row[0]:{widths[0]}}", *map(str.rjust, row[1:], widths[1:])] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, rule, *others])


def draw(report: Report) -> Figure | None:
    """Time per step against error; an error that is better high is taken from 1."""
    if report.error is None:
        return None
    metric, marks = METRICS[report.error], []
    text = _title(metric.name) + (f" ({metric.unit})" if metric.unit else "")
    for row in report.rows:
        time, error = row.spreads.get("step_time"), row.spreads.get(metric.name)
        if time is not None and error is not None:
            ends = error.low, error.median, error.high
            if metric.direction == "high":
                ends = 1 - error.high, 1 - error.median, 1 - error.low
            marks.append(ParetoPoint(row.label, (time.low, time.median, time.high), ends, row.optimal))
    if not marks:
        return None
    below = "  ·  ".join(report.measured[name] for name in ("machine", "seeds", "build"))
    title = f"Speed against error: {report.name}"
    error_text = f"1 - {text}" if metric.direction == "high" else text
    return draw_pareto(title, below, marks, "time per step (us), median", error_text)


def save_report(report: Report, directory: Path) -> list[Path]:
    """Writes table.csv, table.json and table.md, and pareto.png where there is something to draw."""
    content = json.dumps(asdict(report), indent=1, allow_nan=False) + "\n"
    paths = [directory / f"table.{kind}" for kind in ("csv", "json", "md")]
    for path, text in zip(paths, (_csv(report), content, f"{render(report)}\n"), strict=True):
        write_text_atomically(path, text)
    picture, figure = directory / "pareto.png", draw(report)
    if figure is None:
        picture.unlink(missing_ok=True)  # of an earlier call
        return paths
    write_atomically(picture, figure.savefig)
    return [*paths, picture]


def _cell(found: Spread | None, kind: str, base: Spread | None) -> str:
    if found is None:
        return "-"
    text = format_number(found.mean if kind in MEANS else found.median)
    if kind in MEANS and found.sd is not None:
        text += f" ± {format_number(found.sd)}"
    if found.sd is not None and found.worst is not None:
        text += f" ({format_number(found.worst)})"
    if base is not None:
        change = found.median - base.median
        share = change / base.median if base.median else math.nan
        text += " =" if not change else f" {share:+.0%}" if math.isfinite(share) else f" {change:+.3g}"
    return text


def format_number(value: float) -> str:
    """A number with two or three digits."""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}" if abs(value) < 0.1 else f"{value:.3g}"


def _title(name: str) -> str:
    return f"{name}: {METRICS[name].label.strip()}"


def _note(report: Report) -> str:
    kind = "Means ± standard deviation" if report.kind in MEANS else "Medians"
    note = f"{kind} over runs (worst)" + ", and the difference from the first row" * (report.kind in COMPARED)
    note += f"; {'; '.join(report.measured.values())}."
    if report.kind == "pareto":
        note += (
            "\nrun_time: with simulation, sensing and scoring. The first run of a row compiles (worst), the "
            "others fetch what they share.\n"
        )
        if report.error is None:
            return note + "No row has an error to compare its speed with."
        note += f"Bold: no other row is at least as fast and as good by {_title(report.error)}."
    return note


def describe_machines(machines: Sequence[Machine], seeds: int) -> dict[str, str]:
    """The conditions of a measurement of speed, by name."""

    def every(texts: Sequence[str]) -> str:
        return " and ".join(dict.fromkeys(texts)) or "unknown"

    versions = [", ".join(f"{name} {value}" for name, value in each.versions.items()) for each in machines]
    return {
        "machine": every([_machine_text(each) for each in machines]),
        "versions": every(versions),
        "build": f"build {every([each.build for each in machines])}",
        "seeds": f"{seeds} seed{'s' if seeds != 1 else ''}",
    }


def _machine_text(machine: Machine) -> str:
    if machine.device != "cpu":
        return f"{machine.processor}, {machine.device}"
    at_once = "one run at a time" if machine.workers == 1 else f"{machine.workers} runs at a time"
    return f"{machine.processor}, {os.cpu_count()} cores, {at_once}"


def find_disturbances(machines: Sequence[Machine]) -> list[str]:
    """What impairs a comparison of the records: sentences."""
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


def _csv(report: Report) -> str:
    lines = []
    for row in report.rows:
        cells = {name: getattr(row, name) for name in ("row", "runs", "failed", "steps")}
        cells |= {key: plain(value) for key, value in row.varied.items()} | {"optimal": int(row.optimal)}
        for name, found in row.spreads.items():
            cells |= {f"{name}_{part}": value for part, value in asdict(found).items() if part != "values"}
        lines.append(cells)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(chain.from_iterable(lines))), lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return text.getvalue()
