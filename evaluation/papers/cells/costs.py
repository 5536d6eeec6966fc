"""The tables of costs on one core: the analysis of recorded cells, and 1,000 networks over 30,000 steps."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.cells.analysis import analyse_cells
from evaluation.cells.head_direction import mean_vector_length, rayleigh_p
from evaluation.cells.information import information, mean_rate
from evaluation.cells.rate_map import rate_maps, tuning_curves
from evaluation.cells.recording import CellRecording
from evaluation.cells.shuffling import path_bins, shuffled_scores
from evaluation.papers.cells.panels import time_call
from evaluation.papers.cells.rat_sessions import SECONDS, record_rat
from evaluation.papers.cells.shuffles import PLACE_SCORES
from evaluation.papers.figure import Figure
from evaluation.papers.tables.markdown import table_lines
from evaluation.studies.cell_study import cell_study, score_task, tasks_of
from evaluation.studies.machine import one_core, peak_memory, processor_name, reset_peak_memory, watch_load

CELLS, SHUFFLES, ROUNDS = 500, 100, 3
"""Cells with grid scores, shuffles of each, and repeats of the other rows."""
ANALYSES = (
    ("rate maps, information, tuning", "5"),
    ("all scores of `analyse_cells`", ""),
    ("grid scores with shuffles", "60"),
)
"""With the goals of their wall time, s."""
Times = list[tuple[float, ...]]
"""A row each: numbers, in the order of the columns of the table."""


def measure_analysis(
    cells: int = CELLS, shuffles: int = SHUFFLES, seconds: float = SECONDS, seed: int = 0
) -> tuple[str, Times]:
    """What is measured, as sentences; number of cells, processor and wall time (s) of each analysis of a
    session of a rat.

    Args:
        cells: with grid scores. shuffles: of each. seconds: of the session.
    """
    recording = record_rat("rat", cells, sums=True, seconds=seconds, seed=seed)
    bins, score = path_bins(recording, "place"), PLACE_SCORES["grid score"]
    sums = recording._replace(cell=recording.cell[:0], activity=recording.activity[:, :0])
    calls = partial(_map_and_tune, recording), partial(analyse_cells, sums)
    with on_one_core() as found:
        repeats = [[time_call(call) for call in calls] for _ in range(ROUNDS)]
        times = np.median(repeats, axis=0).tolist()
        times.append(time_call(partial(shuffled_scores, recording.activity, bins, score, shuffles, seed)))
    every = int(np.prod(recording.shape))
    note = (
        f"A session of a rat of {seconds:.0f} s at 20 Hz in 20 x 20 place and 36 heading bins; "
        f"{shuffles} shuffles of each cell. {found[0]}"
    )
    counts = every, every, len(recording.cell)
    return note, [(count, *taken) for count, taken in zip(counts, times, strict=True)]


def _map_and_tune(recording: CellRecording) -> None:
    """Rate maps, spatial information and head-direction tuning of all cells of the sums."""
    assert recording.sums is not None
    hz = len(recording.sums.place)
    for part in recording.sums.parts():
        maps, curves = rate_maps(part), tuning_curves(part)
        information(maps, part.seconds) * mean_rate(maps, part.seconds)
        mean_vector_length(curves, part.heading_seconds)
        rayleigh_p(curves * hz, part.heading_seconds)


def _table_analysis(result: tuple[str, Times]) -> list[str]:
    note, times = result
    rows = [
        (name, cells, f"{processor:.2f}", f"{wall:.2f}", goal)
        for (name, goal), (cells, processor, wall) in zip(ANALYSES, times, strict=True)
    ]
    return table_lines([note], ("analysis", "cells", "processor s", "wall s", "goal s"), rows)


ANALYSIS = Figure(
    "What the analysis costs",
    lambda task: measure_analysis(task.sessions or CELLS, seed=task.first),
    _table_analysis,
    None,
)

SETS, MEASURED, STEPS = 1000, 16, 30_000
"""Sets of the goal, sets measured unless the task says otherwise, and steps."""
GOALS = {"path integration": 20, "with views": 45}
"""Minutes."""


def measure_networks(sets: int = MEASURED, steps: int = STEPS) -> tuple[str, Times]:
    """Measures a study in float32 on a random walk in a box of 1 m, without its compiling.

    Args:
        sets: parameter sets. steps: at 50 Hz.

    Returns:
        what is measured, as sentences; of each goal the sets, processor and wall time of a step and set, us,
        and of the goal, min, and the most memory of the process meanwhile, MB.
    """
    rows: Times = []
    with on_one_core() as found:
        for name in GOALS:
            own = [f"views={str(name == 'with views').lower()}", f"steps={steps}", f"sets={sets}"]
            own += [f"rat_simulation.seconds={steps / 50}", "rat_simulation.rate_hz=50", "seed=0"]
            own += ["rat_simulation.walk={}", "rat_simulation.views.every=5", "session.reserve=2048"]
            tasks = tasks_of(cell_study(Path("rat_box"), own))
            score_task(_whole(tasks[0]._replace(parameters=tasks[0].parameters[:1])))
            reset_peak_memory()
            each = [time_call(partial(score_task, _whole(task))) for task in tasks]
            times = [sum(column) / (sets * steps) for column in zip(*each, strict=True)]
            goal = [time * SETS * STEPS / 60 for time in times]
            rows.append((sets, *(1e6 * time for time in times), *goal, peak_memory() * 2**20 / 1e6))
    how = "measured" if sets >= SETS else f"extrapolated from {sets} sets"
    note = (
        f"The study `--preset cells` in float32 on a random walk, {steps} steps at 50 Hz; views "
        f"at 10 Hz. Compiling is not included. Minutes are {how}. {found[0]}"
    )
    return note, rows


def _whole(task: Any) -> Any:
    """A chunk that is not filled up."""
    return task._replace(plan=task.plan.model_copy(update={"chunk": len(task.parameters)}))


def _table_networks(result: tuple[str, Times]) -> list[str]:
    note, rows = result
    columns = (
        "networks", "sets measured", "us a step and set", "wall us", "1,000 sets x 30,000 steps, min",
        "wall min", "goal min", "memory MB",
    )  # fmt: skip
    cells = (
        [name, sets, *(f"{time:.1f}" for time in times), goal, f"{memory:.0f}"]
        for (name, goal), (sets, *times, memory) in zip(GOALS.items(), rows, strict=True)
    )
    return table_lines([note], columns, cells)


NETWORKS = Figure(
    "Many networks", lambda task: measure_networks(task.sessions or MEASURED), _table_networks, None
)


@contextmanager
def on_one_core() -> Iterator[list[str]]:
    """Keeps the process on its idlest core; after the block the list has one sentence on machine and load."""
    found, load = list[str](), watch_load()
    with one_core():
        yield found
    others = load()
    busy = "unknown" if others is None else f"{others:.1f} cores busy with other processes in the mean"
    found.append(f"On one core of {processor_name()}; load of the machine: {busy}.")
