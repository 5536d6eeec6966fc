"""The table of shuffled controls: how many shuffled and how many true cells exceed their own shuffles."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple, get_args

import numpy as np

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
from evaluation.cells.rate_map import (
    arena_edges,
    coherence,
    heading_index,
    place_index,
    sample_seconds,
    smooth_rates,
)
from evaluation.cells.recording import CellRecording
from evaluation.cells.shuffling import Calibration, PathBins, Score, calibrate, shuffled_scores
from evaluation.papers.cells.rat_sessions import SECONDS, Way, record_rat, with_active_cells
from evaluation.papers.figure import Figure, Task
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.studies.executor import run_tasks

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
    task: Task, cells: int = CELLS, shuffles: int = SHUFFLES, seconds: float = SECONDS
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


FIGURE = Figure("Shuffled controls", check_shuffles, shuffle_table, None)


SMOOTHING = 1.5
"""Standard deviation of the Gaussian over place, bins."""


def smoothed(score: Score) -> Score:
    """The score of the smoothed map."""
    return lambda rates, seconds: score(smooth_rates(rates, seconds, SMOOTHING), seconds)


PLACE_SCORES: Mapping[str, Score] = {
    "information": smoothed(information),
    "information rate": smoothed(information_rate),
    "1 - sparsity": smoothed(lambda rates, seconds: 1 - sparsity(rates, seconds)),
    "selectivity": smoothed(selectivity),
    "coherence": coherence,
    "largest field": smoothed(largest_field),
    "border score": smoothed(border_score),
    "grid score": smoothed(lambda rates, seconds: lattice_scores(autocorrelogram(rates), HEXAGONAL)),
    "square score": smoothed(lambda rates, seconds: lattice_scores(autocorrelogram(rates), SQUARE)),
}
"""Scores of maps of 20 x 20 bins."""
HEADING_SCORES: Mapping[str, Score] = {
    "mean vector length": mean_vector_length,
    "Rayleigh z": rayleigh_z,
    "heading information": information,
}
"""Scores of tuning curves of 36 bins, not smoothed."""
JOINT_SCORES: Mapping[str, Score] = {"conjunctive information": conjunctive_information}
"""Scores of maps of 8 headings and 10 x 10 bins, not smoothed."""


def place_bins(recording: CellRecording, bins: int = 20) -> PathBins:
    """The place bin of each step, of `bins` x `bins` over the box that the path fills."""
    flat = place_index(recording.truth, *arena_edges(recording.truth, bins))
    return PathBins(flat, (bins, bins), sample_seconds(recording.time))


def heading_bins(recording: CellRecording, bins: int = 36) -> PathBins:
    """The heading bin of each step."""
    return PathBins(heading_index(recording.truth, bins), (bins,), sample_seconds(recording.time))


def joint_bins(recording: CellRecording) -> PathBins:
    """The bin of heading and place of each step, 8 x 10 x 10."""
    place, turn = place_bins(recording, 10), heading_bins(recording, 8)
    flat = np.where((place.flat < 0) | (turn.flat < 0), -1, turn.flat * 100 + place.flat)
    return PathBins(flat, (8, 10, 10), place.seconds)


BINS: Mapping[Callable[[CellRecording], PathBins], Mapping[str, Score]] = {
    place_bins: PLACE_SCORES,
    heading_bins: HEADING_SCORES,
    joint_bins: JOINT_SCORES,
}
"""The scores of each kind of bins."""
