"""The table of shuffled controls: how many shuffled and how many true cells exceed their own shuffles."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import get_args

import numpy as np

from evaluation.cells import rate_map
from evaluation.cells.fields import border_score, largest_field
from evaluation.cells.grid_score import HEXAGONAL, SQUARE, autocorrelogram, lattice_scores
from evaluation.cells.head_direction import mean_vector_length, rayleigh_z
from evaluation.cells.information import (
    conjunctive_information,
    information,
    information_rate,
    selectivity,
    sparsity,
)
from evaluation.cells.recording import CellRecording
from evaluation.cells.shuffling import Calibration, Score, calibrate, path_bins, shuffled_scores
from evaluation.papers.cells.rat_sessions import SECONDS, Way, record_rat
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import table_lines
from evaluation.studies.executor import run_tasks

CELLS, TRUE_CELLS, SHUFFLES = 500, 100, 100
"""Cells of the calibration, cells of the positive control, and shuffles of each."""
COLUMNS = (
    "path", "score", "cells", "shuffled cells above", "goal", "within", "tied", "mean of shuffles",
    "true cells above", "mean of true cells",
)  # fmt: skip


_Row = tuple[Way, str, Calibration, float, float]
"""One score on one path: of the true cells the share above the percentile of their shuffles, and the mean
score."""


def check_shuffles(task: Task, shuffles: int = SHUFFLES, seconds: float = SECONDS) -> tuple[str, list[_Row]]:
    """Compares cells of a session with their shuffles, for every score and path; what is compared, as
    sentences, and the rows.

    Args:
        task: its sessions are the cells of the calibration. shuffles: of each cell. seconds: of the session.
    """
    cells = task.sessions or CELLS
    true_cells = min(cells, TRUE_CELLS)
    tasks = []
    for way in get_args(Way):
        recording = record_rat(way, cells, seconds=seconds, seed=task.first)
        tasks += [(recording, way, kind, score) for kind, scores in SCORES.items() for score in scores]
    compare = partial(_compare, true_cells=true_cells, shuffles=shuffles, seed=task.first)
    rows = list(run_tasks(compare, tasks, task.workers))
    note = (
        f"Pose cells of sessions of {seconds:.0f} s in a box of 1 m, {shuffles} shuffles "
        "of each cell, with rates in units of activity. Goal: the share of shuffled cells above the "
        "95th percentile of their own shuffles lies in the binomial 95 % band round 5 %. Of 26 "
        "shares, one or two are outside by chance. Tied: share at the percentile, which is not above "
        f"it. Control: of the first {true_cells} cells as recorded, the share above theirs."
    )
    return note, rows


def _compare(task: tuple[CellRecording, Way, str, str], true_cells: int, shuffles: int, seed: int) -> _Row:
    recording, way, kind, name = task
    bins, score = path_bins(recording, kind), SCORES[kind][name]
    checked = calibrate(recording.activity, bins, score, shuffles, seed)
    true = shuffled_scores(recording.activity[:, :true_cells], bins, score, shuffles, seed)
    known = np.isfinite(true.score) & np.isfinite(true.percentile)
    share, mean = (float(each[known].mean()) if known.any() else np.nan for each in (true.above, true.score))
    return way, name, checked, share, mean


def _shuffle_table(result: tuple[str, list[_Row]]) -> list[str]:
    note, found = result
    rows = []
    for way, score, cells, true_share, true_mean in found:
        share, low, high, tied, true = (
            f"{100 * each:.1f} %" for each in (cells.share, cells.low, cells.high, cells.tied, true_share)
        )
        within = "yes" if cells.low <= cells.share <= cells.high else "**no**"
        shuffled = cells.cells, share, f"{low} - {high}", within, tied, f"{cells.shuffled_mean:.3g}"
        rows.append([way, score, *shuffled, true, f"{true_mean:.3g}"])
    return table_lines([note], COLUMNS, rows)


FIGURE = Figure("Shuffled controls", check_shuffles, _shuffle_table, None)


SMOOTHING = 1.5
"""Standard deviation of the Gaussian over place, bins."""


def _smoothed(score: Score) -> Score:
    """The score of the smoothed map."""
    return lambda rates, seconds: score(rate_map.smooth_rates(rates, seconds, SMOOTHING), seconds)


PLACE_SCORES: Mapping[str, Score] = {
    "information": _smoothed(information),
    "information rate": _smoothed(information_rate),
    "1 - sparsity": _smoothed(lambda rates, seconds: 1 - sparsity(rates, seconds)),
    "selectivity": _smoothed(selectivity),
    "coherence": rate_map.coherence,
    "largest field": _smoothed(largest_field),
    "border score": _smoothed(border_score),
    "grid score": _smoothed(lambda rates, seconds: lattice_scores(autocorrelogram(rates), HEXAGONAL)),
    "square score": _smoothed(lambda rates, seconds: lattice_scores(autocorrelogram(rates), SQUARE)),
}
"""Scores of maps of 20 x 20 bins."""
SCORES: Mapping[str, Mapping[str, Score]] = {
    "place": PLACE_SCORES,
    "heading": {
        "mean vector length": mean_vector_length,
        "Rayleigh z": rayleigh_z,
        "heading information": information,
    },
    "joint": {"conjunctive information": conjunctive_information},
}
"""The scores of each kind of bins: tuning curves of 36, and maps of 8 headings and 10 x 10, are not
smoothed."""
