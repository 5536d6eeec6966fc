"""The main figures of a run, for the head of the page and the table of several runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from evaluation.artifacts.manifest import RUNNING
from evaluation.metrics.scorecard import position_error
from evaluation.report.run_report import RunReport

LISTED = 6
"""Number of pieces of a map whose steps are listed."""
_ENDS = {"complete": "finished", RUNNING: "not finished"}


class KeyFigure(NamedTuple):
    """A figure in the head of the page: what it is, its value with the unit, and a remark."""

    label: str
    value: str
    note: str = ""


class Comparison(NamedTuple):
    """A table: the headings of its columns, and a row of cells for each run, its name first."""

    columns: list[str]
    rows: list[list[str]]


def key_figures(report: RunReport) -> list[KeyFigure]:
    """The figures of one run, the most important first."""
    figures = [_error(report), *_pieces(report), *_grid(report)]
    if warned := len(report.run.warnings):
        figures.append(KeyFigure("Input", "warned", f"{warned} warning{'s' * (warned > 1)}"))
    if len(report.run.nodes):
        figures.append(
            KeyFigure("Experiences", f"{len(report.run.nodes):,}", f"{len(report.run.links):,} links")
        )
    if report.closures.verdicts:
        count, accepted = len(report.closures.verdicts), int(report.closures.accepted().sum())
        figures.append(KeyFigure("Closures accepted", f"{accepted:,}", f"of {count:,} considered"))
    count, lasted = len(report.run.time), float(report.run.time[-1] - report.run.time[0])
    duration = f"{lasted:.3g} s" if lasted < 120 else f"{lasted / 60:.3g} min"
    figures.append(KeyFigure("Duration", duration, f"{count:,} steps"))
    if len(report.cost.value):
        cost = 1e3 * float(np.median(report.cost.value))
        figures.append(KeyFigure("Cost of a step", f"{cost:.3g} ms", "median"))
    return figures


def compare_figures(reports: Sequence[RunReport]) -> Comparison:
    """The figures of several runs, a row each; "–" where a run has none."""
    columns = [
        "run", "method", "status", "steps", "doubt", "final, m", "online, m",
        "odometry, m", "experiences", "closures", "refused", "ms a step",
    ]  # fmt: skip
    return Comparison(columns, [_row(report) for report in reports])


def _row(report: RunReport) -> list[str]:
    final, online = (report.card.quantities[name] for name in ("ate_final", "ate_online"))
    closures, accepted = len(report.closures.verdicts), int(report.closures.accepted().sum())
    doubt = report.run.doubt
    return [
        report.name,
        report.backend or "–",
        _ENDS.get(report.manifest.status, report.manifest.status),
        f"{len(report.run.time):,}",
        "–" if np.isnan(doubt) else f"{doubt:.0%}",
        *(_number(value) for value in (final.value, online.value, final.odometry)),
        f"{len(report.run.nodes):,}" if len(report.run.nodes) else "–",
        *((f"{accepted:,}", f"{closures - accepted:,}") if closures else ("–", "–")),
        _number(1e3 * float(np.median(report.cost.value)) if len(report.cost.value) else None),
    ]


def _error(report: RunReport) -> KeyFigure:
    error = position_error(report.card)
    if error.value is None:
        return KeyFigure("Position error", "unknown", "no truth to compare with")
    note = "" if error.odometry is None else f"odometry {error.odometry:.3g} {error.unit}"
    return KeyFigure("Position error", f"{error.value:.3g} {error.unit}", note)


def _pieces(report: RunReport) -> list[KeyFigure]:
    """Of a map in several pieces: how many, the share of steps outside the largest, and the steps of each."""
    if not report.run.has_pieces:
        return []
    sizes = np.sort(np.unique(report.run.piece, return_counts=True)[1])[::-1]
    share = 1 - sizes[0] / sizes.sum()
    listed = ", ".join(f"{size:,}" for size in sizes[:LISTED].tolist())
    more = " ..." if len(sizes) > LISTED else ""
    return [KeyFigure("Pieces", f"{len(sizes)}", f"{share:.0%} of the steps unjoined; {listed}{more} steps")]


def _grid(report: RunReport) -> list[KeyFigure]:
    if report.grid_score is None or report.grid_score.quantities["map_brier"].value is None:
        return []
    score = report.grid_score.quantities
    skill = score["map_brier_skill"].value
    note = "" if skill is None else f"skill {skill:.3g}"
    return [KeyFigure("Grid, Brier score", f"{score['map_brier'].value:.3g}", note)]


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"
