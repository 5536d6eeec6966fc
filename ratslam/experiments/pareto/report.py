"""The frontier told: as text, as a table for a README, as files for programs, as a picture."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from evaluation.plots.pareto_plot import ParetoPoint, draw_pareto
from ratslam.experiments.pareto.error_metrics import ErrorOf
from ratslam.experiments.pareto.summary import WHOLE, Line, Span
from ratslam.experiments.studies.report import label
from tactile.base.atomic_write import write_atomically, write_text_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = {
    "step_time": "us a cycle",
    "step_time_p99": "99 %",
    WHOLE: "whole run",
    "compile_time": "compile s",
    "memory": "MiB",
    "exm_arr": "ARR",
    "exm_arcr_strict": "ARCR",
    "energy_all": "EM",
    "ate_final": "ATE m",
    "map_error": "map error",
}
"""Headings."""


class Frontier(NamedTuple):
    """All that was found.

    Attributes:
        study: its name. error: what speed is held against; None if no row has any. lines: its rows.
        measured: where, with what and how often, by name. remarks: sentences. others: cores that other
            processes kept busy; None where nobody knows.
    """

    study: str
    error: ErrorOf | None
    lines: Sequence[Line]
    measured: Mapping[str, str]
    remarks: Sequence[str]
    others: float | None = None


def text(found: Frontier) -> str:
    """As plain text."""
    columns = list(zip(*_cells(found, "* {}", "  {}"), strict=True))
    filled = [[f"{cell:>{max(map(len, column))}}" for cell in column] for column in columns[1:]]
    names = [f"{cell:<{max(map(len, columns[0]))}}" for cell in columns[0]]
    return "\n".join([*map("  ".join, zip(names, *filled, strict=True)), "", *_notes(found, "* ")])


def markdown(found: Frontier) -> str:
    """As a table of Markdown, optimal rows in bold."""
    head, *rows = _cells(found, "**{}**", "{}")
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([table, "", *_notes(found, "Bold: ")]) + "\n"


def picture(found: Frontier) -> Figure | None:
    """Time against error; None if no row has both."""
    marks = [
        ParetoPoint(label(line.row, line.varied), _ends(time), _ends(line.error), line.optimal)
        for line in found.lines
        if (time := line.spans.get("step_time")) is not None and line.error is not None
    ]
    if found.error is None or not marks:
        return None
    below = "  ·  ".join(found.measured[name] for name in ("machine", "seeds", "build"))
    title = f"Speed against error: {found.study}"
    return draw_pareto(title, below, marks, "time per cycle (us), median", found.error.label)


def save(found: Frontier, directory: Path) -> list[Path]:
    """frontier.csv, .json, .md and .png, each in one piece; no picture where there is nothing to draw."""
    paths = [directory / f"frontier.{kind}" for kind in ("csv", "json", "md", "png")]
    for path, content in zip(paths, (_csv(found), _json(found), markdown(found)), strict=False):
        write_text_atomically(path, content)
    figure = picture(found)
    if figure is None:
        paths.pop().unlink(missing_ok=True)  # of an earlier call, which had something to draw
        return paths
    write_atomically(paths[-1], figure.savefig)
    return paths


def number(value: float | None) -> str:
    """Short, with the digits that count."""
    if value is None:
        return "-"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.2g}" if abs(value) < 0.1 else f"{value:.3g}"


def _cells(found: Frontier, best: str, other: str) -> list[list[str]]:
    """Headings and rows; `best` and `other` frame the names of optimal rows and of others."""
    names = [name for name in COLUMNS if any(name in line.spans for line in found.lines)]
    shown = found.error is None or found.error.quantity in names
    own = [] if shown or found.error is None else [found.error.name]
    rows = [[other.format(""), "seeds", "cycles", *(COLUMNS[name] for name in names), *own]]
    for line in found.lines:
        name = (best if line.optimal else other).format(label(line.row, line.varied))
        seeds = f"{line.seeds}" + (f", {line.failed} failed" if line.failed else "")
        spans = [*(line.spans.get(each) for each in names), *([line.error] if own else [])]
        rows.append([name, seeds, f"{line.cycles:.0f}", *map(_cell, spans)])
    return rows


def _notes(found: Frontier, mark: str) -> list[str]:
    optimal = "No row has an error to hold its speed against."
    if found.error is not None:
        optimal = f"{mark}no other row is both as fast and as good by the {found.error.label}."
    remarks = [f"{remark[0].upper()}{remark[1:]}." for remark in found.remarks]
    return [
        f"Medians over seeds (worst). {optimal}",
        "Whole run: simulating, sensing and judging included, us a cycle. The first of a row's seeds "
        "compiles (worst), others fetch what they share.",
        f"{'; '.join(found.measured.values())}.",
        *remarks,
    ]


def _cell(span: Span | None) -> str:
    if span is None:
        return "-"
    several = sum(value is not None for value in span.values) > 1 and span.worst is not None
    return number(span.median) + (f" ({number(span.worst)})" if several else "")


def _ends(span: Span) -> tuple[float, float, float]:
    return span.low, span.median, span.high


def _csv(found: Frontier) -> str:
    names = list(dict.fromkeys(name for line in found.lines for name in line.spans))
    keys = list(dict.fromkeys(key for line in found.lines for key in line.varied))
    told = io.StringIO()
    writer = csv.writer(told, lineterminator="\n")
    parts = ("median", "low", "high", "worst")
    heads = [f"{name}_{part}" for name in ["error", *names] for part in parts]
    writer.writerow(["row", *keys, "seeds", "failed", "cycles", "optimal", *heads])
    for line in found.lines:
        spans = [line.error, *(line.spans.get(name) for name in names)]
        cells = [getattr(span, part) if span else None for span in spans for part in parts]
        chosen = [json.dumps(line.varied[key]) if key in line.varied else "" for key in keys]
        start = [line.row, *chosen, line.seeds, line.failed, line.cycles, int(line.optimal)]
        writer.writerow([*start, *("" if cell is None else repr(cell) for cell in cells)])
    return told.getvalue()


def _json(found: Frontier) -> str:
    rows = [
        line._asdict()
        | {"spans": {name: span._asdict() for name, span in line.spans.items()}}
        | {"error": line.error and line.error._asdict()}
        for line in found.lines
    ]
    content: dict[str, Any] = {
        "study": found.study,
        "error": found.error and {"name": found.error.name, "label": found.error.label},
        "measured": dict(found.measured),
        "remarks": list(found.remarks),
        "others": found.others,
        "rows": rows,
    }
    return json.dumps(content, indent=1, allow_nan=False) + "\n"
