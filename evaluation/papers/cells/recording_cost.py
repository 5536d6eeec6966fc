"""The recording table: what the recording of pose cells adds to a step, as a share of a step without it.

The sessions of all rows advance in turn, a chunk at a time, on one core, so that they share its state and
that of other processes; only ratios carry over to other machines. The time of each chunk is the median of
the rounds. Compiling is not included; the file at the end is a column of its own.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from evaluation.metrics.resources import peak_memory, reset_peak_memory
from evaluation.papers.cells.figure import CellFigure
from evaluation.papers.cells.timing import on_one_core, time_call
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from ratslam.core.packing import PackedRecords, allocate, layout_of
from ratslam.core.precision import prepare_precision
from ratslam.core.session import CHUNK, Session, run_chunk
from ratslam.runs.build_session import build_session
from ratslam.runs.cell_recorder import CellRecorder, open_cell_recorder
from ratslam.runs.settings.run_config import LoopConfig
from robot.sources.in_memory import InMemorySource
from robot.sources.odometry import from_poses
from robot.sources.source import Sample
from tactile.base.random_streams import stream
from tactile.base.types import Observation

SETTINGS: Mapping[str, Any] = {"backend": "classic", "pose_cells": {"cell_size": 0.05}}
"""Of the sessions: 21 x 21 x 36 cells, a torus of 1.05 m."""
RECORDINGS: Mapping[str, Mapping[str, Any] | None] = {
    "nothing": None,
    "64 chosen cells at every step": {"chosen": 64},
    "sums of all cells at 10 Hz": {"chosen": 0, "sums": {"bins": 20, "heading_bins": 36, "rate": 10.0}},
    "both": {"chosen": 64, "sums": {}},
}
"""Sections `cells` of the rows."""
GOALS: Mapping[str, str] = {
    "64 chosen cells at every step": "10 %",
    "sums of all cells at 10 Hz": "30 %, 400 MB",
}
"""Goals of the rows: largest share of a step added, and memory."""
ROUNDS, STEPS = 5, 30_000
"""Repeats, and steps of the walk: 600 s."""
RATE = 50.0
"""Steps per second."""
SPEED, TURNING = 0.2, 4.0
"""Of the walk: m/s, and standard deviation of the turning rate, rad/s."""
Chunk = tuple[PackedRecords, int]
"""Packed observations and their number."""
COLUMNS = (
    "recording", "step us", "added us", "of a step", "of a step, wall", "of the kernel alone", "goal",
    "file s", "memory MB",
)  # fmt: skip


class RecordingCost(NamedTuple):
    """Times of R rounds of N chunks, each of processor and wall time, s.

    Attributes:
        steps: of the walk. kernel: [R, N, 2] of the compiled kernel alone. sessions: [R, rows, N, 2]. file:
            [R, rows, 2] at the end. memory: [rows] most of a session alone above that at its start, MB.
        circumstances: a sentence about machine and load.
    """

    steps: int
    kernel: np.ndarray
    sessions: np.ndarray
    file: np.ndarray
    memory: np.ndarray
    circumstances: str


class _Recording:
    """One row: a session and, in a round, its recorder."""

    def __init__(self, cells: Mapping[str, Any] | None, walk: InMemorySource) -> None:
        self._config, self._walk = LoopConfig.model_validate({**SETTINGS, "cells": cells}), walk
        self.session = build_session(self._config, walk)
        self._recorder: CellRecorder | None = None

    def begin(self, folder: Path) -> None:
        """Starts from an empty map."""
        self.session.restart()
        self._recorder = open_cell_recorder(self._config, self._walk, self.session.backend, folder)

    def advance(self, samples: Sequence[Sample]) -> None:
        """Maps and records a chunk."""
        steps = list(self.session.replay([sample.reading for sample in samples]))
        if self._recorder is not None:
            self._recorder.add(samples, steps)

    def finish(self) -> None:
        """Writes the file."""
        if self._recorder is not None:
            self._recorder.finish()


def measure_cost(rounds: int = ROUNDS, steps: int = STEPS) -> RecordingCost:
    """Measures the cost of all recordings.

    Args:
        rounds: repeats. steps: of the walk, at 50 Hz.
    """
    prepare_precision("float64")
    walk = box_walk(0, steps)
    samples = list(walk)
    parts = [samples[first : first + CHUNK] for first in range(0, steps, CHUNK)]
    chunks = pack([sample.reading for sample in samples])
    rows = [_Recording(cells, walk) for cells in RECORDINGS.values()]
    plain = rows[0].session
    kernel = jax.jit(partial(run_chunk, plain.backend.kernel), donate_argnums=0)
    with on_one_core() as found:
        time_kernel(kernel, plain, chunks[:1])
        memory = [_most_memory(row, parts) for row in rows]
        taken = [(time_kernel(kernel, plain, chunks), *_time_rows(rows, parts)) for _ in range(rounds)]
    alone, sessions, file = (np.array(times) for times in zip(*taken, strict=True))
    return RecordingCost(steps, alone, sessions, file, np.array(memory), circumstances=found.text)


def cost_table(result: RecordingCost) -> Iterator[str]:
    """The lines of the table."""
    kernel, _ = _each_step(result.kernel, result.steps)
    steps = _each_step(result.sessions, result.steps)
    file = np.median(result.file, axis=0)[:, 0]
    yield (
        f"21 x 21 x 36 cells, {result.steps} steps at {RATE:.0f} Hz, {len(result.kernel)} rounds. Without "
        f"recording a step takes {steps[0, 0]:.0f} us of processor time, {steps[0, 1]:.0f} us on the wall; "
        f"its kernel alone {kernel:.0f} us. Processor times unless stated. {result.circumstances}\n"
    )
    yield markdown_header(COLUMNS)
    for k, name in enumerate(RECORDINGS):
        more = steps[k] - steps[0]
        shares = (*(more / steps[0]), more[0] / kernel)
        yield markdown_row(
            [
                name, f"{steps[k, 0]:.0f}", f"{more[0]:.1f}", *(f"{100 * share:.1f} %" for share in shares),
                GOALS.get(name, ""), f"{file[k]:.2f}", f"{result.memory[k]:.0f}",
            ]
        )  # fmt: skip


def _each_step(times: np.ndarray, steps: int) -> np.ndarray:
    """[..., 2] us a step of times [R, ..., N, 2] of chunks."""
    return 1e6 * np.median(times, axis=0).sum(axis=-2) / steps


def _most_memory(row: _Recording, parts: Sequence[Sequence[Sample]]) -> float:
    with tempfile.TemporaryDirectory() as folder:
        row.session.restart()
        row.session.warm(parts[0][0].reading)
        reset_peak_memory()
        before = peak_memory()
        row.begin(Path(folder))
        for part in parts:
            row.advance(part)
        row.finish()
        return (peak_memory() - before) * 2**20 / 1e6


def _time_rows(rows: Sequence[_Recording], parts: Sequence[Sequence[Sample]]) -> tuple[Any, Any]:
    """Times of all rows [rows, N, 2] and of their files [rows, 2]; each chunk begins with another row."""
    times = np.empty((len(rows), len(parts), 2))
    with tempfile.TemporaryDirectory() as folder:
        for k, row in enumerate(rows):
            (Path(folder) / str(k)).mkdir()
            row.begin(Path(folder) / str(k))
        for n, part in enumerate(parts):
            for k in np.roll(np.arange(len(rows)), n).tolist():
                times[k, n] = time_call(partial(rows[k].advance, part))
        return times, np.array([time_call(row.finish) for row in rows])


def time_kernel(kernel: Callable[..., Any], session: Session, chunks: Sequence[Chunk]) -> np.ndarray:
    """Times [N, 2] of the compiled kernel alone over packed observations, from the start."""
    session.restart()
    state, times = session.state, []

    def advance(chunk: PackedRecords, count: int) -> None:
        nonlocal state
        state, _ = kernel(state, chunk, np.int32(count))
        jax.block_until_ready(state)

    for chunk, count in chunks:
        times.append(time_call(partial(advance, chunk, count)))
    return np.array(times)


def pack(observations: Sequence[Observation]) -> list[Chunk]:
    """Chunks of observations and their numbers."""
    layout, chunks = layout_of(observations[0]), []
    for first in range(0, len(observations), CHUNK):
        chunk, part = allocate(layout, CHUNK), observations[first : first + CHUNK]
        for k, observation in enumerate(part):
            chunk.write(k, observation)
        chunks.append((chunk, len(part)))
    return chunks


def box_walk(seed: int, steps: int) -> InMemorySource:
    """A random walk in a box of 1 m x 1 m at 50 Hz with exact odometry and without views.

    The speed is constant and the turning rate white noise; before a wall the robot turns to the middle.
    """
    turn = stream(seed, "experiments.box_walk").normal(0.0, TURNING / RATE, steps)
    pose, poses = np.array([0.5, 0.5, 0.0]), np.empty((steps, 3))
    for k in range(steps):
        poses[k] = pose
        heading = pose[2] + turn[k]
        ahead = pose[:2] + SPEED / RATE * np.array([np.cos(heading), np.sin(heading)])
        if not ((ahead > 0.05) & (ahead < 0.95)).all():
            to_middle = np.arctan2(0.5 - pose[1], 0.5 - pose[0])
            heading = pose[2] + np.clip((to_middle - pose[2] + np.pi) % (2 * np.pi) - np.pi, -0.2, 0.2)
            ahead = pose[:2]
        pose = np.array([*ahead, heading])
    time = np.arange(steps) / RATE
    return InMemorySource(
        name="box walk",
        digest="",
        time=time,
        motion=from_poses(time, poses),
        moved=np.ones(steps, bool),
        views=np.zeros((steps, 1, 8, 1)),
        seen=np.zeros(steps, bool),
        label=np.full(steps, -1, np.int32),
        truth=poses,
    )


FIGURE = CellFigure(
    "What recording costs",
    lambda task: measure_cost(task.sessions or ROUNDS),
    lambda result: list(cost_table(result)),
    None,
)
