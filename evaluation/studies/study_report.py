"""The report of a study: statistics over runs, the Pareto front, tables and the picture of speed and error.

Rows are statistics over the seeds and copies of a configuration. The table is text, Markdown, CSV and JSON;
the picture shows error against time per step with the Pareto front.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, product
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from evaluation.metrics.metric import Direction
from evaluation.metrics.statistics import pareto_optimal
from evaluation.plots import style
from evaluation.plots.style import BLUE, GREY, INK, LABEL_GREY, VERMILLION
from evaluation.studies.machine import Machine
from evaluation.studies.metrics import COLUMNS, DEFAULT_ERRORS, MEASURED, METRICS
from evaluation.studies.run_job import RunRecord
from evaluation.studies.study import StudyPlan
from tactile.base.files import write_atomically, write_text_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


DEAD_RECKONING = "dead reckoning"  # name of the row of raw odometry


@dataclass(frozen=True)
class _Spread:
    """Statistics of a quantity over the runs of a row."""

    values: tuple[float | None, ...]  # by run, None where it has none
    mean: float
    sd: float | None  # standard deviation; None of a single value
    median: float
    low: float
    high: float
    worst: float | None  # None where neither high nor low values are better


@dataclass(frozen=True)
class _Row:
    """One configuration of a study."""

    row: str  # name
    varied: dict[str, Any]  # combination of the varied settings, by key path
    runs: int  # number of runs with an outcome
    failed: int  # number of the others
    steps: float  # median number of observations
    spreads: dict[str, _Spread]  # by quantity, without those that no run has
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


def _mark_optimal(rows: Sequence[_Row], objectives: Mapping[str, Direction], statistic: str) -> list[_Row]:
    """The rows with `optimal` set by the mean or median of each objective.

    Only a row whose runs all have all objectives can be optimal.
    """
    costs = []  # low values are better; NaN where a run lacks an objective
    for row, (name, direction) in product(rows, objectives.items()):
        found = row.spreads.get(name)
        known = not row.failed and found is not None and None not in found.values
        value: float = getattr(found, statistic) if known else np.nan
        costs.append(-value if direction == "high" else value)
    best = pareto_optimal(np.array(costs).reshape(-1, len(objectives)))
    return [replace(row, optimal=bool(each)) for row, each in zip(rows, best, strict=True)]


def spread(values: Sequence[float | None], name: str) -> _Spread | None:
    """Statistics of a quantity's values; None if there is no value."""
    known = [float(value) for value in values if value is not None]
    if not known:
        return None
    low, high = min(known), max(known)
    worst = {"low": high, "high": low, None: None}[METRICS[name].direction if name in METRICS else None]
    deviation = statistics.stdev(known) if len(known) > 1 else None
    mean, median = statistics.fmean(known), statistics.median(known)
    return _Spread(tuple(values), mean, deviation, median, low, high, worst)


def _row(group: Sequence[RunRecord], odometry: bool = False) -> _Row:
    fine = [record for record in group if record.error is None]
    names = dict.fromkeys([metric.name for metric in MEASURED])
    names |= dict.fromkeys(each for record in fine for each in record.quantities)
    value = RunRecord.odometry if odometry else RunRecord.value
    spreads = {each: spread([value(run, each) for run in fine], each) for each in names}
    row, varied, failed = group[0].row, group[0].varied, len(group) - len(fine)
    if odometry:
        row, varied, failed = DEAD_RECKONING, {}, 0
    steps = statistics.median([record.steps for record in fine]) if fine else 0.0
    known = {each: found for each, found in spreads.items() if found is not None}
    return _Row(row, varied, len(fine), failed, steps, known)


_TALL, _EACH, _BOTTOM = 4.4, 0.13, 0.95  # inches: height of the axes, extra per point beyond 12, below
_FLOOR = 0.5  # an error of 0 is drawn at this share of the least positive error
# Pixels: grid of label positions, gap around labels (across, up), distance from which a line is drawn.
_GRID, _GAP, _NEAR = 3.0, (5.0, 2.0), 14.0
# Cost, in pixels of distance, of a label that crosses a bar, or is nearer to another point.
_CROSSING, _MISTAKEN = 8.0, 16.0
_SIZE = 7.6  # of labels, points


class ParetoPoint(NamedTuple):
    """One configuration.

    Attributes:
        name: its label. time, error: (minimum, median, maximum) over seeds. optimal: on the Pareto front.
    """

    name: str
    time: tuple[float, float, float]
    error: tuple[float, float, float]
    optimal: bool


def draw_pareto(title: str, line: str, marks: Sequence[ParetoPoint], time: str, error: str) -> style.Figure:
    """Draws the points on logarithmic axes, with bars from minimum to maximum over seeds.

    Args:
        marks: at least one point. time, error: axis labels with units.
    """
    figure, axes = style.new_chart(_TALL + _EACH * max(0, len(marks) - 12), _BOTTOM, title, line)
    spans = np.array([[mark.time, mark.error] for mark in marks])  # [N, 2, 3]
    positive = spans[:, 1][spans[:, 1] > 0]
    floor = _FLOOR * positive.min() if len(positive) else 1.0
    spans[:, 1] = np.maximum(spans[:, 1], floor)
    best = np.array([mark.optimal for mark in marks])
    style.log_axes(axes, spans[:, 0], spans[:, 1])
    _paint(axes, spans, best)
    none = bool((spans[:, 1] == floor).any())
    style.name_axes(axes, time, f"{error}{', 0 at the bottom' if none else ''}")
    style.add_legend(figure, axes)
    _label(axes, [mark.name for mark in marks], spans, best)
    return figure


def _place_labels(
    size: np.ndarray, anchor: np.ndarray, area: np.ndarray, blocked: np.ndarray, crossed: np.ndarray
) -> np.ndarray:
    """Places labels one after the other, each at the free position nearest to its anchor.

    Labels overlap neither each other nor blocked boxes while the area has room; after that, a label goes
    where it hides the least.

    Args:
        size: [N, 2] size of the labels. anchor: [N, 2] points that they belong to. area: [4] left, bottom,
            right, top. blocked: [M, 4] boxes not to cover. crossed: [L, 4] boxes to avoid.

    Returns:
        [N, 2] lower left corners.
    """
    room = np.array([-_GAP[0], -_GAP[1], _GAP[0], _GAP[1]])
    taken, corners = list(np.asarray(blocked, float) + room / 2), np.zeros((len(size), 2))
    anchor = np.asarray(anchor, float)
    for k, ((width, height), at) in enumerate(zip(size, anchor, strict=True)):
        x = np.arange(area[0], max(area[2] - width, area[0]) + 1e-9, _GRID)
        y = np.arange(area[1], max(area[3] - height, area[1]) + 1e-9, _GRID)
        spots = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        boxes = np.concatenate([spots, spots + [width, height]], axis=1)
        away = _away(boxes, anchor)
        cost = away[:, k] + _MISTAKEN * (np.delete(away, k, axis=1) < away[:, k : k + 1]).sum(axis=1)
        # At equal distance, a label beside the point reads better than one above it.
        cost += 0.02 * np.abs((boxes[:, 1] + boxes[:, 3]) / 2 - at[1])
        cost += _CROSSING * (_overlap(boxes, np.reshape(crossed, (-1, 4))) > 0).sum(axis=1)
        hidden = _overlap(boxes, np.reshape(taken, (-1, 4))).sum(axis=1)
        chosen = np.lexsort((cost, hidden))[0]
        corners[k] = spots[chosen]
        taken.append(boxes[chosen] + room)
    return corners


def _away(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distances [N, M] from boxes to points, pixels."""
    low, high = boxes[:, None, :2] - points, points - boxes[:, None, 2:]
    return np.hypot(*np.moveaxis(np.maximum(np.maximum(low, high), 0.0), -1, 0))


def _overlap(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[N, M] area of each box that each other box covers, pixels squared."""
    low = np.maximum(boxes[:, None, :2], others[None, :, :2])
    high = np.minimum(boxes[:, None, 2:], others[None, :, 2:])
    return np.maximum(high - low, 0.0).prod(axis=2)


def _front(axes: style.Axes, spans: np.ndarray, best: np.ndarray) -> np.ndarray:
    """The corners [P, 2] of the staircase of the Pareto front, up to the right end; [0, 2] without points."""
    front = spans[best][:, :, 1]
    if not len(front):
        return front
    front = front[np.lexsort((front[:, 1], front[:, 0]))]
    end = np.array([[axes.get_xlim()[1], front[-1, 1]]])
    across = np.stack([np.append(front[1:, 0], end[0, 0]), front[:, 1]], axis=1)  # first right, then down
    return np.stack([front, across], axis=1).reshape(-1, 2)


def _paint(axes: style.Axes, spans: np.ndarray, best: np.ndarray) -> None:
    time, error = spans[:, 0], spans[:, 1]
    front = _front(axes, spans, best)
    if len(front):
        axes.plot(*front.T, color=VERMILLION, lw=1.3, label="Pareto front", zorder=2)
    for some, color, size, name in ((best, BLUE, 5.5, "Pareto-optimal"), (~best, GREY, 4.5, "dominated")):
        if some.any():
            bars = [np.abs(values[some][:, [0, 2]] - values[some][:, 1:2]).T for values in (time, error)]
            axes.errorbar(
                time[some, 1], error[some, 1], xerr=bars[0], yerr=bars[1], fmt="o", ms=size, mew=0,
                color=color, elinewidth=0.9, alpha=0.95, zorder=4 if some is best else 3, label=name,
            )  # fmt: skip


def _label(axes: style.Axes, names: Sequence[str], spans: np.ndarray, best: np.ndarray) -> None:
    """Labels the points, the optimal ones first; distant labels get a line to their point."""
    from matplotlib.patheffects import withStroke

    size = _SIZE * axes.figure.dpi / 72
    halo = [withStroke(linewidth=2.0, foreground="white")]
    texts = [
        axes.annotate(
            name, (0, 0), xycoords="figure pixels", fontsize=_SIZE, path_effects=halo, zorder=5,
            color=INK if top else LABEL_GREY,
        )
        for name, top in zip(names, best, strict=True)
    ]  # fmt: skip
    boxes = [text.get_window_extent() for text in texts]
    sizes = np.array([[box.width, box.height] for box in boxes])
    at = axes.transData.transform(spans[:, :, 1])
    low, high = axes.transData.transform(spans[:, :, 0]), axes.transData.transform(spans[:, :, 2])
    stairs = axes.transData.transform(_front(axes, spans, best).reshape(-1, 2))
    dots = np.concatenate([at - size / 2.2, at + size / 2.2], axis=1)
    ends = np.minimum(stairs[1:], stairs[:-1]) - 1, np.maximum(stairs[1:], stairs[:-1]) + 1
    blocked = np.concatenate([dots, np.concatenate(ends, axis=1)])
    across = np.stack([low[:, 0], at[:, 1] - 1, high[:, 0], at[:, 1] + 1], axis=1)
    up = np.stack([at[:, 0] - 1, low[:, 1], at[:, 0] + 1, high[:, 1]], axis=1)
    bars = np.concatenate([across, up])
    order = np.lexsort((at[:, 0], ~best))
    frame = np.array(axes.get_window_extent().extents)
    corners = _place_labels(sizes[order], at[order], frame, blocked, bars)
    for k, corner in zip(order, corners, strict=True):
        texts[k].xyann = tuple(corner - [boxes[k].x0, boxes[k].y0])
        near = np.clip(at[k], corner, corner + sizes[k])
        away = _away(np.concatenate([corner, corner + sizes[k]])[None], at)[0]
        if away[k] > min(_NEAR, 1.5 * np.delete(away, k).min(initial=np.inf)):
            axes.annotate(
                "", at[k], near, xycoords="figure pixels", textcoords="figure pixels",
                arrowprops={"arrowstyle": "-", "color": GREY, "lw": 0.6, "shrinkA": 0, "shrinkB": 3},
            )  # fmt: skip


DISTURBED = 0.3  # load of other processes from which a measurement of speed counts as disturbed, cores
KEPT = 1.25  # largest final ATE of a row that counts as kept, relative to the first row's
MEANS = ("means", "search")  # kinds of report that show means; others show medians
COMPARED = ("differences", "costs")  # kinds of report that show the difference of each row from the first
PACES = {"live": "one step at a time", "replay": "a chunk of steps at a time"}


@dataclass(frozen=True)
class _Report:
    """The outcome of a study."""

    name: str  # of the study
    kind: str  # of the table
    columns: Sequence[str]  # quantities shown
    rows: Sequence[_Row]
    error: str | None  # quantity of the Pareto front
    measured: dict[str, str]  # machine, versions, build, seeds and pace, by name
    remarks: Sequence[str]  # sentences


def make_report(
    name: str, plan: StudyPlan, records: Sequence[RunRecord], error: str | None = None, search: bool = False
) -> _Report:
    """The report of a study's records.

    Args:
        error: quantity of the Pareto front; None: the first default error that most rows have. search:
            whether the records are of the trials of a search; then the Pareto-optimal ones are marked.
    """
    kind = "search" if search else plan.report
    groups: dict[str, list[RunRecord]] = {}
    for record in records:
        groups.setdefault(json.dumps([record.row, record.varied]), []).append(record)
    rows = [_row(group) for group in groups.values()]
    if groups and kind in ("medians", "differences"):
        rows.append(_row(next(iter(groups.values())), odometry=True))
    if kind != "pareto":
        error = None
    elif error is None:  # the first default error that most rows have in all of their runs
        whole = [name for row in rows for name, found in row.spreads.items() if None not in found.values]
        first = max(DEFAULT_ERRORS, key=whole.count)
        error = first if first in whole else None
    columns, remarks = [*COLUMNS.get(kind, ()), *([error] if error else [])], list[str]()
    if error is not None:
        rows = _mark_optimal(rows, {"step_time": "low", error: METRICS[error].direction}, "median")
    if search and plan.tune is not None:
        columns, rows = [*plan.tune.directions()], _mark_optimal(rows, plan.tune.directions(), "mean")
        best, failed = sum(row.optimal for row in rows), sum(bool(row.failed) for row in rows)
        remarks = [f"{len(rows)} trials, {best} of them Pareto-optimal, {failed} failed"]
    if kind == "differences":
        remarks = _kept(rows, plan.limit)
    machines = [record.machine for record in records if record.machine]
    seeds = len({record.seed for record in records})
    measured = describe_machines(machines, seeds) | {"pace": PACES[plan.pace]}
    columns = list(dict.fromkeys(columns))
    return _Report(name, kind, columns, rows, error, measured, [*remarks, *find_disturbances(machines)])


def render(report: _Report) -> str:
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


def _draw(report: _Report) -> Figure | None:
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


def save_report(report: _Report, directory: Path) -> list[Path]:
    """Writes table.csv, table.json and table.md, and pareto.png where there is something to _draw."""
    lines, figure = [], _draw(report)
    for row in report.rows:
        cells = {name: getattr(row, name) for name in ("row", "runs", "failed", "steps")}
        cells |= {key: plain(value) for key, value in row.varied.items()} | {"optimal": int(row.optimal)}
        for name, found in row.spreads.items():
            cells |= {f"{name}_{part}": value for part, value in asdict(found).items() if part != "values"}
        lines.append(cells)
    content, table = json.dumps(asdict(report), indent=1, allow_nan=False), csv_text(lines)
    files = {"table.csv": table, "table.json": f"{content}\n", "table.md": f"{render(report)}\n"}
    return save_files(directory, files | {"pareto.png": figure})


def csv_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows by column as CSV, with the columns of all rows."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(chain.from_iterable(rows))), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def save_files(folder: Path, files: Mapping[str, Any]) -> list[Path]:
    """Writes texts, figures, and what functions write to a path, into the folder of a study; returns their
    paths. A file that is None is not written, and that of an earlier call goes."""
    for name, content in files.items():
        if content is None:
            (folder / name).unlink(missing_ok=True)
        elif isinstance(content, str):
            write_text_atomically(folder / name, content)
        else:
            write_atomically(folder / name, getattr(content, "savefig", content))
    return [folder / name for name, content in files.items() if content is not None]


def _cell(found: _Spread | None, kind: str, base: _Spread | None) -> str:
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


def _note(report: _Report) -> str:
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

    names = []
    for each in machines:
        at_once = "one run at a time" if each.workers == 1 else f"{each.workers} runs at a time"
        where = f"{os.cpu_count()} cores, {at_once}" if each.device == "cpu" else each.device
        names.append(f"{each.processor}, {where}")
    versions = [", ".join(f"{name} {value}" for name, value in each.versions.items()) for each in machines]
    return {
        "machine": every(names),
        "versions": every(versions),
        "build": f"build {every([each.build for each in machines])}",
        "seeds": f"{seeds} seed{'s' if seeds != 1 else ''}",
    }


def find_disturbances(machines: Sequence[Machine]) -> list[str]:
    """What impairs a comparison of the records: sentences."""
    builds, processors = {each.build for each in machines}, {each.processor for each in machines}
    found = []
    if len(builds) > 1:
        found.append(f"the records are of {len(builds)} builds of ratslam; delete them to run all again")
    if len(processors) > 1 or max((each.workers for each in machines), default=1) > 1:
        causes = "several runs at a time, or several machines, disturb times"
        found.append(f"{causes}: measure speed with --workers 1")
    load = max((each.other_load or 0.0 for each in machines if each.workers == 1), default=0.0)
    if load > DISTURBED:
        found.append(f"other processes kept up to {load:.1f} cores busy meanwhile, which lengthens times")
    return found


def _kept(rows: Sequence[_Row], limit: float | None) -> list[str]:
    """The share of rows after the first whose final error stays within a limit."""
    others = rows[1:-1]
    base = rows[0].spreads.get("ate_final") if rows else None
    if base is None or not others:
        return ["without true poses there is no error to compare"] if others else []
    most = KEPT * base.high if limit is None else limit
    finals = [row.spreads.get("ate_final") for row in others]
    kept = sum(final is not None and final.high <= most for final in finals)
    return [f"{kept} of {len(others)} rows ({kept / len(others):.0%}) end at an ATE of {most:.3g} m or less"]
