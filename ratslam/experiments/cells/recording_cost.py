"""The recording table: what the recording of pose cells adds to a step, as a share of a step without it.

The sessions take turns on one core, so that they share its state; only ratios carry over to other machines.
Times are processor times. Compiling is not included; the file at the end is a column of its own.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import jax
import numpy as np

from ratslam.config.run_config import LoopConfig
from ratslam.core.packing import PackedRecords, allocate, layout_of
from ratslam.core.precision import prepare_precision
from ratslam.core.session import CHUNK, Session, run_chunk
from ratslam.experiments.tables.markdown import markdown_header, markdown_row
from ratslam.pipeline.build_session import build_session
from ratslam.pipeline.cell_recorder import open_cell_recorder
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
RATE = 50.0
"""Steps per second."""
SPEED, TURNING = 0.2, 4.0
"""Of the walk: m/s, and standard deviation of the turning rate, rad/s."""
Chunk = tuple[PackedRecords, int]
"""Packed observations and their number."""
COLUMNS = ("recording", "step us", "added us", "of the kernel alone", "of a step", "file s", "memory MB")


class Recorded(NamedTuple):
    """Processor time of a step, us, and of the file at the end, s; most memory above the start, MB."""

    step: float
    file: float
    memory: float


def recording_cost(rounds: int = 5, steps: int = 30_000) -> Iterator[str]:
    """The lines of the table, after all rounds; pins the process to one core meanwhile.

    Args:
        rounds: repeats, of which the median is taken. steps: of the walk, at 50 Hz.
    """
    prepare_precision("float64")
    walk = box_walk(0, steps)
    samples = list(walk)
    configs = {
        name: LoopConfig.model_validate({**SETTINGS, "cells": cells}) for name, cells in RECORDINGS.items()
    }
    sessions = {name: build_session(config, walk) for name, config in configs.items()}
    chunks = pack([sample.reading for sample in samples])
    kernel = jax.jit(partial(run_chunk, sessions["nothing"].backend.kernel), donate_argnums=0)
    with one_core():
        for session in sessions.values():
            session.warm(samples[0].reading)
        time_kernel(kernel, sessions["nothing"], chunks[:1])
        alone, taken = [], []
        for _ in range(rounds):
            alone.append(time_kernel(kernel, sessions["nothing"], chunks) / steps)
            taken.append(
                [record(configs[name], walk, samples, session) for name, session in sessions.items()]
            )
    step_alone = 1e6 * float(np.median(alone))
    medians = np.median(np.array(taken), axis=0)
    plain = medians[0, 0]
    yield f"{steps} steps, {rounds} rounds; a step: kernel alone {step_alone:.0f} us, all {plain:.0f} us\n"
    yield markdown_header(COLUMNS)
    for name, (step, file, memory) in zip(sessions, medians.tolist(), strict=True):
        more = step - plain
        shares = (f"{100 * more / part:.1f} %" for part in (step_alone, plain))
        yield markdown_row([name, f"{step:.0f}", f"{more:.1f}", *shares, f"{file:.2f}", f"{memory:.0f}"])


def record(config: LoopConfig, walk: InMemorySource, samples: Sequence[Sample], session: Session) -> Recorded:
    """The cost of one session from the start."""
    session.restart()
    with tempfile.TemporaryDirectory() as folder:
        before = begin_peak()
        recorder = open_cell_recorder(config, walk, session.backend, Path(folder))
        began = process_time()
        for first in range(0, len(samples), CHUNK):
            part = samples[first : first + CHUNK]
            steps = list(session.replay([sample.reading for sample in part]))
            if recorder is not None:
                recorder.add(part, steps)
        ended = process_time()
        if recorder is not None:
            recorder.finish()
        closed = process_time()
        return Recorded(1e6 * (ended - began) / len(samples), closed - ended, peak() - before)


def time_kernel(kernel: Callable[..., Any], session: Session, chunks: Sequence[Chunk]) -> float:
    """Processor time of the compiled kernel alone over packed observations, from the start, s."""
    session.restart()
    state = session.state
    began = process_time()
    for chunk, count in chunks:
        state, _ = kernel(state, chunk, np.int32(count))
    jax.block_until_ready(state)
    return process_time() - began


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


@contextmanager
def one_core() -> Iterator[None]:
    """Pins the process to one of its cores."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def begin_peak() -> float:
    """Forgets the peak of resident memory so far; returns the resident memory, MB."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    return _status("VmRSS")


def peak() -> float:
    """Peak of resident memory since `begin_peak`, MB."""
    return _status("VmHWM")


def _status(name: str) -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(f"{name}:")) / 1000
