"""The table of shuffled controls: how many shuffled and how many true cells exceed their own shuffles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, get_args

import numpy as np

from evaluation.cells.recording import CellRecording
from evaluation.cells.shuffling import Calibration, calibrate, shuffled_scores
from ratslam.experiments.cells.figure import CellFigure, CellTask
from ratslam.experiments.cells.rat_sessions import SECONDS, Way, record_rat, with_active_cells
from ratslam.experiments.cells.shuffled import BINS
from ratslam.experiments.studies.executor import run_tasks
from ratslam.experiments.tables.markdown import markdown_header, markdown_row

CELLS, TRUE_CELLS, SHUFFLES = 500, 100, 100
"""Cells of the calibration, cells of the positive control, and shuffles of each."""
COLUMNS = (
    "path", "score", "cells", "shuffled cells above", "goal", "within", "tied", "mean of shuffles",
    "true cells above", "mean of true cells",
)  # fmt: skip


class ShuffledRow(NamedTuple):
    """One score on one path. true_share: of the true cells above the percentile of their shuffles.
    true_mean: their mean score."""

    way: Way
    score: str
    calibration: Calibration
    true_share: float
    true_mean: float


class ShuffleCheck(NamedTuple):
    """The rows, and the numbers that they are made with."""

    rows: list[ShuffledRow]
    true_cells: int
    shuffles: int
    seconds: float


class _Task(NamedTuple):
    recording: CellRecording
    way: Way
    kind: int
    score: str
    true_cells: int
    shuffles: int
    seed: int


def check_shuffles(
    task: CellTask, cells: int = CELLS, shuffles: int = SHUFFLES, seconds: float = SECONDS
) -> ShuffleCheck:
    """Compares cells of a session with their shuffles, for every score and path.

    Args:
        task: its sessions are the cells of the calibration. cells: where the task does not say. shuffles: of
            each cell. seconds: of the session.
    """
    cells = task.sessions or cells
    true_cells = min(cells, TRUE_CELLS)
    tasks = []
    for way in get_args(Way):
        recording = with_active_cells(record_rat(way, 2 * cells, seconds=seconds, seed=task.first), cells)
        for kind, scores in enumerate(BINS.values()):
            own = true_cells, shuffles, task.first
            tasks += [_Task(recording, way, kind, score, *own) for score in scores]
    rows = list(run_tasks(_compare, tasks, task.workers))
    return ShuffleCheck(rows, true_cells, shuffles, seconds)


def _compare(task: _Task) -> ShuffledRow:
    recording = task.recording
    bins_of, scores = list(BINS.items())[task.kind]
    bins, score = bins_of(recording), scores[task.score]
    checked = calibrate(recording.activity, bins, score, task.shuffles, task.seed)
    true = shuffled_scores(recording.activity[:, : task.true_cells], bins, score, task.shuffles, task.seed)
    known = np.isfinite(true.score) & np.isfinite(true.percentile)
    share, mean = (float(each[known].mean()) if known.any() else np.nan for each in (true.above, true.score))
    return ShuffledRow(task.way, task.score, checked, share, mean)


def shuffle_table(result: ShuffleCheck) -> Iterator[str]:
    """The lines of the table."""
    yield (
        f"Pose cells of sessions of {result.seconds:.0f} s in a box of 1 m, {result.shuffles} shuffles "
        "of each cell, with rates in units of activity. Goal: the share of shuffled cells above the "
        "95th percentile of their own shuffles lies in the binomial 95 % band round 5 %. Of 26 "
        "shares, one or two are outside by chance. Tied: share at the percentile, which is not above "
        f"it. Control: of the first {result.true_cells} cells as recorded, the share above theirs.\n"
    )
    yield markdown_header(COLUMNS)
    for row in result.rows:
        found = row.calibration
        yield markdown_row(
            [
                row.way, row.score, found.cells, _percent(found.share),
                f"{_percent(found.low)} - {_percent(found.high)}",
                "yes" if found.low <= found.share <= found.high else "**no**",
                _percent(found.tied), f"{found.shuffled_mean:.3g}", _percent(row.true_share),
                f"{row.true_mean:.3g}",
            ]
        )  # fmt: skip


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


FIGURE = CellFigure("Shuffled controls", check_shuffles, lambda result: list(shuffle_table(result)), None)
