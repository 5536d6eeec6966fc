"""One run of a study: a session played in memory, scored and timed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import jax
import numpy as np

from evaluation.artifacts.grid_npz import read_grid
from evaluation.metrics.energy_metric import read_relations
from evaluation.metrics.grid_error import MAIN_CONVENTION
from evaluation.metrics.grid_score import score_grid
from evaluation.metrics.metric import Quantity
from evaluation.metrics.run_arrays import RunArrays
from evaluation.metrics.scorecard import score_run
from ratslam.config.run_config import RunConfig
from ratslam.core.session import CHUNK, Session
from ratslam.experiments.studies.environment import machine, other_load, peak_memory
from ratslam.experiments.studies.fidelity import compare_with_tier
from ratslam.experiments.studies.records import RunRecord, Timing
from ratslam.experiments.studies.study import Job
from ratslam.experiments.studies.timing import Stopwatch
from ratslam.pipeline.artifacts import true_grid
from ratslam.pipeline.online_error import OnlineErrorLog
from ratslam.pipeline.runner import build_session
from ratslam.pipeline.source import open_observations, read_observations
from robot.sources.in_memory import InMemorySource, load_into_memory
from robot.sources.perturbation import perturb
from robot.sources.source import Source
from robot.world.arena import read_arena
from tactile.base.errors import InputError
from tactile.base.se2 import compose, integrate, inverse

SAME_PLACE = 2.5
"""Largest true distance between the ends of a true loop closure, pose cells."""


def run_job(job: Job) -> RunRecord:
    """Runs a job in this process. An `InputError` is recorded, so that the study continues."""
    blank = RunRecord(
        hash=job.hash, seed=job.seed, copy_number=job.copy_number, row=job.row, varied=job.varied
    )
    with other_load() as load:
        try:
            with _precision(job.config.session.precision), peak_memory() as memory:
                found = _play(job)
        except InputError as error:
            return blank.model_copy(update={"error": str(error), "machine": machine()})
        here = machine().model_copy(update={"other_load": load()})
    return blank.model_copy(update=found | {"memory": memory(), "machine": here})


def run_job_alone(task: tuple[Job, Path]) -> RunRecord:
    """Runs a job in a fresh process, with a cache of compiled kernels in the given folder."""
    job, kernels = task
    jax.config.update("jax_compilation_cache_dir", str(kernels))
    return run_job(job)


class _Steps(NamedTuple):
    """Arrays over the steps of a session, as `Run` has them, and whether the pose was lost."""

    time: np.ndarray
    odometry: np.ndarray
    truth: np.ndarray
    online: np.ndarray
    place: np.ndarray
    lost: np.ndarray


def _play(job: Job) -> dict[str, Any]:
    """The fields of a record that follow from playing a job's configuration."""
    began, config = perf_counter(), job.config
    relations = read_relations(config.score.relations) if config.score.relations else None
    with open_observations(config) as (config, source):
        extra: dict[str, Quantity] = {}
        if job.reference_tier is not None:
            source = load_into_memory(source)
            extra = compare_with_tier(config, source, perf_counter() - began, job.reference_tier)
        if job.copy_number:
            source = _perturbed(source, config, job.copy_number)
        watch, present = Stopwatch(), OnlineErrorLog()
        with watch.preparing():
            session = build_session(config, source, job.ablation)
        steps = _take(session, source, job.pace, watch, present)
        with watch.finishing():
            final = session.map.trajectory()
        run = _run(session, steps, final)
        card = score_run(
            run._replace(online_error=np.array(present.errors)),
            source.name,
            exm=config.score.experience_metric,
            relations=relations,
        )
        cell = config.pose_cells.cell_size
        extra |= _closures(session, steps, cell) | _anchored(steps, final) | _chart(session, source)
    timing = Timing(pace=job.pace, **watch.summary(), total_s=perf_counter() - began)
    quantities = card.quantities | extra
    return {"steps": len(steps.time), "source": source.digest, "quantities": quantities, "timing": timing}


def _perturbed(source: Source, config: RunConfig, copy_number: int) -> InMemorySource:
    if config.recording is None:
        source = load_into_memory(source)
    if not isinstance(source, InMemorySource):
        raise InputError("recording.file", "a recording that is streamed", "a CSV or .npz recording")
    return perturb(source, copy_number)


def _take(session: Session, source: Source, pace: str, watch: Stopwatch, present: OnlineErrorLog) -> _Steps:
    time, motion, truth, online, places, lost = [], [], [], [], [], []
    rows = read_observations(source)
    while chunk := list(islice(rows, CHUNK)):
        steps = []
        for part in [chunk] if pace == "replay" else [[row] for row in chunk]:
            with watch.taking(len(part)):
                steps += list(session.replay([reading for _, reading in part]))
        time += [float(sample.time) for sample, _ in chunk]
        motion += [np.asarray(reading.odometry[:3], float) for _, reading in chunk]
        truth += [np.full(3, np.nan) if sample.truth is None else sample.truth for sample, _ in chunk]
        online += [step.pose for step in steps]
        places += [int(step.estimate.place) for step in steps]
        lost += [bool(step.estimate.lost) for step in steps]
        present.update(session, truth)
    if not time:
        raise InputError(source.name, "no samples", "a session")
    every = np.array(time), integrate(np.array(motion)), np.array(truth), np.array(online)
    return _Steps(*every, np.array(places), np.array(lost))


def _run(session: Session, steps: _Steps, final: np.ndarray) -> RunArrays:
    """The session as arrays, as `evaluation.artifacts.run_directory.read_run` reads one from its files."""
    graph = session.map.graph()
    nodes = np.array([[row["x"], row["y"], row["heading"]] for _, row in sorted(graph.nodes(data=True))])
    nodes = nodes.reshape(-1, 3)
    place = np.where(steps.place < len(nodes), steps.place, -1)
    return RunArrays(
        time=steps.time,
        truth=steps.truth if np.isfinite(steps.truth).all(axis=1).any() else None,
        online=steps.online,
        final=final,
        odometry=steps.odometry,
        experience=place,
        created=np.array([int(np.argmax(place == node)) for node in range(len(nodes))], int),
        nodes=nodes,
        links=np.array(list(graph.edges), int).reshape(-1, 2),
    )


def _closures(session: Session, steps: _Steps, cell: float) -> dict[str, Quantity]:
    """Number of loop closures, of false ones, and share of steps with a lost pose."""
    closures, truth = session.map.closures(), steps.truth
    false = None
    if np.isfinite(truth).all(axis=1).any():
        apart = np.hypot(*(truth[closures[:, 0]] - truth[closures[:, 1]])[:, :2].T)
        false = int((apart > SAME_PLACE * cell).sum())
    return {
        "closures": Quantity(label="loop closures", value=len(closures), unit=""),
        "false_closures": Quantity(label="false loop closures", value=false, unit=""),
        "lost_share": Quantity(label="share of steps lost", value=float(steps.lost.mean()), unit=""),
    }


def _anchored(steps: _Steps, final: np.ndarray) -> dict[str, Quantity]:
    """Mean position errors where the first true pose is given and paths are not aligned."""
    if not np.isfinite(steps.truth).all():
        return {}
    # All backends take the first step from odometry, so its error is not theirs.
    start = compose(steps.truth[0], inverse(steps.odometry[0]))

    def error(path: np.ndarray) -> float:
        return float(np.hypot(*(compose(start, path) - steps.truth)[:, :2].T).mean())

    odometry = error(steps.odometry)
    return {
        f"error_{name}": Quantity(
            label=f"position error, {name}", value=error(path), unit="m", odometry=odometry
        )
        for name, path in (("online", steps.online), ("final", final))
    }


def _chart(session: Session, source: Source) -> dict[str, Quantity]:
    """Scores of a grid map of a known arena."""
    write, arena = session.map.files().get("grid.npz"), source.info.arena
    if write is None or arena is None:
        return {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder / "grid.npz")
        (folder / "arena.txt").write_text(arena, encoding="utf-8")
        grid = read_grid(folder / "grid.npz")
        found = score_grid(grid, true_grid(read_arena(folder / "arena.txt"), grid))
    error = found.under(MAIN_CONVENTION)
    beside = f"0.3 everywhere {error.prior:.3g}, the best constant {error.best:.3g}"
    return {
        "map_error": Quantity(label="map error, eq. 6", value=error.error, unit="", note=beside)
    } | found.quantities


@contextmanager
def _precision(wanted: str) -> Iterator[None]:
    """JAX with the precision of a fresh process, whatever ran in this one before."""
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", wanted == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)
