"""The batch table: µs of a step of networks, of parameter sets in one call and of whole sessions in one call,
on the processor and, if JAX has one, on the GPU beside it.

On a GPU all sets and sessions are computed at once; on the processor sets in blocks that fit into its cache,
and sessions one after another.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import jax
import numpy as np

from evaluation.papers.tables.cycles import SESSIONS
from evaluation.papers.tables.markdown import markdown_header, markdown_row
from evaluation.papers.tables.speed import MOTION, replay_network
from ratslam.classic import batch
from ratslam.classic.pose_cell_config import NetworkConfig, rings, units
from ratslam.core.precision import prepare_precision
from ratslam.methods.recall import RecallBackend
from ratslam.methods.session_batch import Recording, RecordingSession, SessionBatch
from ratslam.runs.build_session import build_session
from ratslam.runs.open_source import open_observations
from ratslam.runs.settings.run_config import load_config
from robot.sources.in_memory import load_into_memory
from robot.touch_source import observation_of

COLUMNS = "what is computed", "device", "us a step of each"
SIZES = 21, 61, 201
"""Cells along one side of the single networks."""
FEW = 200
"""Steps of a call with many sets."""
EVERY = 5
"""Steps from one view to the next."""
RECORDED = 4
"""Different sessions that a batch repeats."""
SINGLE = 400
"""Steps of a single network."""


def batch_table(sets: int, sessions: int, steps: int, rounds: int, folder: Path = Path()) -> Iterator[str]:
    """The lines of the table, each as soon as it is timed.

    Args:
        sets, sessions: number in one call on a GPU; on the processor a fifth of the sets and `RECORDED`
            sessions, as its time for each does not depend on their number. steps: of a session. rounds:
            repeats, of which the median is taken. folder: of the repository, which holds `configs`.
    """
    prepare_precision("float64")
    yield markdown_header(COLUMNS)
    core = jax.devices("cpu")[0]
    with jax.default_device(core):
        backend, recordings = record_circuits(steps, folder)
    for device in dict.fromkeys([jax.devices()[0], core]):
        gpu = device.platform != "cpu"
        name = device.device_kind if gpu else "one core"
        with jax.default_device(device):
            for n in SIZES:
                for engine in ("window", "dense"):
                    replay, start = replay_network(n, engine, SINGLE, np.float32)
                    us = _median(partial(replay, start), SINGLE, rounds)
                    yield markdown_row([f"one network of {n} cells a side, {engine}", name, f"{us:.0f}"])
            many = sets if gpu else max(sets // 5, 1)
            for every in (0, EVERY, 1):
                call = set_call(many, every, many if gpu else batch.BLOCK)
                us = _median(call, many * FEW, rounds)
                views = f"a view every {every} steps" if every else "path integration"
                yield markdown_row([f"{many} sets of 21 cells, {views}", name, f"{us:.2f}"])
            several = sessions if gpu else len(recordings)
            used = [recordings[k % len(recordings)] for k in range(several)]
            run = SessionBatch(backend, at_once=gpu)
            us = _median(partial(run.replay, used), several * steps, rounds)
            gap = belief_gap(run.replay(used), used)
            what = f"{several} sessions of {steps} steps, largest difference of a belief {gap:.0e}"
            yield markdown_row([what, name, f"{us:.1f}"])
    with jax.default_device(core):
        run = SessionBatch(backend, at_once=False)
        us = _median(lambda: [run.replay([each]) for each in recordings], len(recordings) * steps, rounds)
    what = f"{len(recordings)} sessions of {steps} steps, each in a call"
    yield markdown_row([what, "one core", f"{us:.1f}"])


def record_circuits(steps: int, folder: Path) -> tuple[RecallBackend, list[Recording]]:
    """The backend and recordings of the first steps of `RECORDED` whisker sessions of ten circuits whose maps
    need as many pose cells."""
    recordings: list[Recording] = []
    for seed in count():
        config = load_config(folder / SESSIONS["circuits"], [f"simulation.seed={seed}"])
        with open_observations(config) as (config, source):
            log = load_into_memory(source)
        observations = [observation_of(sample) for sample in log][:steps]
        made = build_session(config, log)
        if not seed:
            assert isinstance(made.backend, RecallBackend)
            backend, session = made.backend, RecordingSession(made.backend, reserve=made.reserve)
        found = session.record(observations)
        if not recordings or cells_of(found) == cells_of(recordings[0]):
            recordings.append(found)
        if len(recordings) == RECORDED:
            break
    return backend, recordings


def cells_of(recording: Recording) -> list[tuple[int, ...]]:
    """The numbers of cells along x and y at each chunk."""
    return [chunk.sides for chunk in recording.chunks]


def set_call(sets: int, every: int, block: int) -> Callable[[], Any]:
    """A call of `FEW` steps of many parameter sets, with a view half a torus away every so many steps, 0:
    none."""
    config, single = NetworkConfig(cells_xy=21), np.dtype(np.float32)
    unit, ring = units(config, single), rings(config, single)
    motion = np.tile(np.array([MOTION[0] * unit[0], 0.0, MOTION[1] * unit[2]], single), (FEW, 1))
    seen = np.arange(FEW) % every == every - 1 if every else np.zeros(FEW, bool)
    course = batch.Course(
        motion, np.tile(np.asarray(ring, single) / 2, (FEW, 1)), np.where(seen, 0.02, 0.0).astype(single)
    )
    spread = np.linspace(0.9, 1.1, sets, dtype=single)
    given = batch.Network(spread, 2 * spread, np.full(sets, 2e-5, single), spread)
    return lambda: batch.networks(config, given, course, block)


def belief_gap(states: Any, recordings: list[Recording]) -> float:
    """The largest difference of a belief from that of the single run."""
    return max(
        float(np.abs(np.asarray(found[k], float) - own).max(initial=0.0))
        for k, recording in enumerate(recordings)
        for found, own in zip(states.belief, recording.state.belief, strict=True)
    )


def _median(call: Callable[[], Any], steps: int, rounds: int) -> float:
    """Median us of a step of a call that makes so many, compiled before."""
    times = []
    for _ in range(1 + rounds):
        began = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - began)
    return float(np.median(times[1:])) / steps * 1e6
