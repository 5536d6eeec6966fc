"""The table of costs: time of rate maps, scores and shuffles of recorded cells on one core."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from evaluation.cells.analysis import analyse_cells
from evaluation.cells.head_direction import mean_vector_length, rayleigh_p
from evaluation.cells.information import information, information_rate
from evaluation.cells.rate_map import rate_maps, tuning_curves
from evaluation.cells.recording import CellRecording
from evaluation.cells.shuffling import shuffled_scores
from evaluation.papers.cells.panels import Taken, on_one_core, time_call
from evaluation.papers.cells.rat_sessions import SECONDS, record_rat, with_active_cells
from evaluation.papers.cells.shuffles import PLACE_SCORES, path_bins
from evaluation.papers.figure import Figure
from evaluation.papers.tables.markdown import markdown_header, markdown_row

CELLS, SHUFFLES, ROUNDS = 500, 100, 3
"""Cells with grid scores, shuffles of each, and repeats of the other rows."""
COLUMNS = ("analysis", "cells", "processor s", "wall s", "goal s")
MAPS, ALL, GRID = (
    "rate maps, information, tuning",
    "all scores of `analyse_cells`",
    "grid scores with shuffles",
)
GOALS = {MAPS: "5", ALL: "", GRID: "60"}


def measure_analysis(
    cells: int = CELLS, shuffles: int = SHUFFLES, seconds: float = SECONDS, seed: int = 0
) -> tuple[str, dict[str, tuple[int, Taken]]]:
    """What is measured, as sentences, and number of cells and time of each analysis of a session of a rat.

    Args:
        cells: with grid scores. shuffles: of each. seconds: of the session.
    """
    recording = record_rat("rat", 2 * cells, sums=True, seconds=seconds, seed=seed)
    chosen = with_active_cells(recording, cells)
    shuffle = partial(
        shuffled_scores,
        chosen.activity,
        path_bins(chosen, "place"),
        PLACE_SCORES["grid score"],
        shuffles,
        seed,
    )
    sums = recording._replace(cell=recording.cell[:0], activity=recording.activity[:, :0])
    calls: dict[str, Callable[[], object]] = {
        MAPS: partial(_map_and_tune, recording),
        ALL: partial(analyse_cells, sums),
    }
    with on_one_core() as found:
        repeats = [{name: time_call(call) for name, call in calls.items()} for _ in range(ROUNDS)]
        times = {name: Taken(*np.median([each[name] for each in repeats], axis=0).tolist()) for name in calls}
        times[GRID] = time_call(shuffle)
    every = int(np.prod(recording.shape))
    counts = {MAPS: every, ALL: every, GRID: len(chosen.cell)}
    note = (
        f"A session of a rat of {seconds:.0f} s at 20 Hz in 20 x 20 place and 36 heading bins; "
        f"{shuffles} shuffles of each cell. {found[0]}\n"
    )
    return note, {name: (counts[name], taken) for name, taken in times.items()}


def _map_and_tune(recording: CellRecording) -> None:
    """Rate maps, spatial information and head-direction tuning of all cells of the sums."""
    assert recording.sums is not None
    maps, curves = rate_maps(recording.sums), tuning_curves(recording.sums)
    hz = len(maps)
    information(maps, recording.sums.seconds)
    information_rate(maps, recording.sums.seconds)
    mean_vector_length(curves, recording.sums.heading_seconds)
    rayleigh_p(curves * hz, recording.sums.heading_seconds)


def analysis_table(result: tuple[str, dict[str, tuple[int, Taken]]]) -> Iterator[str]:
    """The lines of the table."""
    note, rows = result
    yield note
    yield markdown_header(COLUMNS)
    for name, (cells, taken) in rows.items():
        yield markdown_row([name, cells, f"{taken.processor:.2f}", f"{taken.wall:.2f}", GOALS[name]])


FIGURE = Figure(
    "What the analysis costs",
    lambda task: measure_analysis(task.sessions or CELLS, seed=task.first),
    analysis_table,
    None,
)
