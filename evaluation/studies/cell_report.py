"""Table and pictures of a study of many networks."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import rankdata

from evaluation.studies.cell_study import PARAMETERS, CellStudy
from evaluation.studies.cell_study_plot import MapRow, draw_rate_maps, draw_scores
from evaluation.studies.set_scores import SetScores
from evaluation.studies.study_report import format_number, render_table
from tactile.base.atomic_write import write_atomically, write_text_atomically

UNITS = {
    "excite_sigma": "cells", "inhibit_sigma": "cells", "global_inhibition": "", "energy": "",
    "speed_noise": "", "heading_noise": "rad / sqrt(s)", "drift": "m", "drift_heading": "rad",
    "drift_end": "m", "drift_heading_end": "rad", "decoding": "m", "decoding_heading": "rad",
    "reseeded": "", "larger": "",
}  # fmt: skip
"""Units of the columns of the table; '' for shares and numbers."""
NOTE = """\
drift: packet, followed round the torus, minus true pose, rms over the course; end: after the last step.
decoding: mean distance on the torus. reseeded: share of steps at which activity had died out. larger: share
of steps that needed more than the smallest window. Rank correlations are Spearman's, over all sets."""


class CellReport(NamedTuple):
    """The scores of a study, with its sets in order of their drift [sets]."""

    study: CellStudy
    scores: SetScores
    order: np.ndarray


def make_cell_report(study: CellStudy, scores: SetScores) -> CellReport:
    """The report of a study's scores."""
    return CellReport(study, scores, np.argsort(scores.drift, kind="stable"))


def render_cells(report: CellReport) -> str:
    """Best, median and worst set by drift, and the rank correlations, as Markdown."""
    table = [["", "set", *(f"{name} {unit}".strip() for name, unit in UNITS.items())]]
    columns = _columns(report)
    for name, k in _chosen(report).items():
        table.append([name, str(k), *(format_number(float(column[k])) for column in columns.values())])
    study = report.study
    links = [["rank correlation with", *PARAMETERS]]
    for name in ("drift", "drift_heading", "decoding", "decoding_heading"):
        links.append([name, *(_rank_correlation(columns[each], columns[name]) for each in PARAMETERS)])
    return "\n".join([render_table(table), "", render_table(links), "", NOTE, _describe(study)])


def save_cells(report: CellReport, folder: Path) -> list[Path]:
    """Writes table.csv with all sets, table.md, maps.npz with all rate maps, and the pictures drift.png,
    decoding.png and maps.png."""
    study, scores = report.study, report.scores
    write_text_atomically(folder / "table.csv", _csv(report))
    write_text_atomically(folder / "table.md", f"{render_cells(report)}\n")
    course = study.course
    write_atomically(
        folder / "maps.npz",
        lambda path: np.savez_compressed(
            path, maps=scores.maps, cell=course.chosen, x_edges=course.x_edges, y_edges=course.y_edges
        ),
    )
    paths = [folder / name for name in ("table.csv", "table.md", "maps.npz")]
    for name, figure in _figures(report).items():
        write_atomically(folder / name, figure.savefig)
        paths.append(folder / name)
    return paths


def _figures(report: CellReport) -> dict:
    study, scores = report.study, report.scores
    columns, line = _columns(report), _describe(study)
    parameters = {f"{name} ({UNITS[name]})".removesuffix(" ()"): columns[name] for name in PARAMETERS}
    rows = [MapRow(name, scores.maps[k]) for name, k in _chosen(report).items()]
    course = study.course
    return {
        "drift.png": draw_scores(f"Drift: {study.name}", line, parameters, scores.drift, "drift, rms (m)"),
        "decoding.png": draw_scores(
            f"Decoding error: {study.name}", line, parameters, scores.decoding, "decoding error (m)"
        ),
        "maps.png": draw_rate_maps(
            f"Rate maps by drift: {study.name}",
            f"Least, median and most drift of {len(scores.drift)} sets; above each map its largest activity",
            rows,
            course.x_edges,
            course.y_edges,
        ),
    }


def _chosen(report: CellReport) -> dict[str, int]:
    """Indices of the best, the median and the worst set by drift."""
    order = report.order
    return {"best": int(order[0]), "median": int(order[len(order) // 2]), "worst": int(order[-1])}


def _columns(report: CellReport) -> dict[str, np.ndarray]:
    parameters = dict(zip(PARAMETERS, report.study.parameters.T, strict=True))
    return {name: parameters[name] if name in parameters else getattr(report.scores, name) for name in UNITS}


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> str:
    if not np.ptp(a) or not np.ptp(b):
        return "-"
    return f"{np.corrcoef(rankdata(a), rankdata(b))[0, 1]:+.2f}"


def _describe(study: CellStudy) -> str:
    course, config = study.course, study.course.config
    side = course.x_edges[-1] - course.x_edges[0]
    torus = config.cells_xy * config.cell_size
    how = "with views" if study.plan.views else "path integration"
    return (
        f"{len(study.parameters)} sets, {len(course.expected)} steps, {course.seconds.sum():.0f} s, {how}, "
        f"{study.plan.precision}; path {side:.2f} m across, torus {torus:.2f} m."
    )


def _csv(report: CellReport) -> str:
    columns = _columns(report)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["set", *columns])
    writer.writerows(
        [k, *(repr(float(column[k])) for column in columns.values())] for k in range(len(report.order))
    )
    return text.getvalue()
