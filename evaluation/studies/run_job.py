"""One run of a study: a session played in memory, scored and timed."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import jax
import numpy as np

from evaluation.artifacts.grid_npz import read_grid
from evaluation.metrics.energy_metric import read_relations
from evaluation.metrics.grid_error import MAIN_CONVENTION
from evaluation.metrics.metric import Finding, Quantity
from evaluation.metrics.occupancy_score import score_grid
from evaluation.metrics.run_arrays import RunArrays
from evaluation.metrics.run_metrics import anchored_errors, recognition_error
from evaluation.metrics.scorecard import score_run
from evaluation.studies.machine import Stopwatch, machine
from evaluation.studies.metrics import quantity
from evaluation.studies.perturbation import perturb
from evaluation.studies.records import RunRecord, record_of
from evaluation.studies.resources import peak_memory, reset_peak_memory, watch_load
from evaluation.studies.study import Job
from evaluation.studies.tiers import compare_with_tier
from ratslam.core.session import CHUNK, Session
from ratslam.runs.artifacts import true_grid
from ratslam.runs.build_session import build_session
from ratslam.runs.online_error import OnlineErrorLog
from ratslam.runs.open_source import open_observations, read_observations
from robot.sources.in_memory import InMemorySource, load_into_memory
from robot.sources.source import Source
from robot.world.arena import read_arena
from tactile.base.errors import InputError
from tactile.base.se2 import integrate

SAME_PLACE = 2.5  # largest true distance between the ends of a true loop closure, pose cells


def run_job(job: Job) -> RunRecord:
    """Runs a job in this process. An `InputError` is recorded, so that the study continues."""
    load = watch_load()
    reset_peak_memory()
    try:
        with _precision(job.config.session.precision):
            found = _play(job)
    except InputError as error:
        return record_of(job, str(error), machine())
    measured = found["measured"] | {"memory": peak_memory()}
    here = machine().model_copy(update={"other_load": load()})
    return record_of(job).model_copy(update=found | {"measured": measured, "machine": here})


def run_job_alone(kernels: Path, job: Job) -> RunRecord:
    """Runs a job in a fresh process; compiled kernels are kept in the given folder for its configuration."""
    jax.config.update("jax_compilation_cache_dir", str(kernels / job.hash))
    return run_job(job)


def _play(job: Job) -> dict[str, Any]:
    """The fields of a record that follow from playing a job's configuration."""
    watch, config = Stopwatch(), job.config
    relations = read_relations(config.score.relations) if config.score.relations else None
    with open_observations(config) as (config, source):
        extra: dict[str, Quantity] = {}
        if job.reference_tier is not None:
            source = load_into_memory(source)
            extra = compare_with_tier(config, source, watch.elapsed(), job.reference_tier)
        if job.copy_number:
            if config.recording is None:
                source = load_into_memory(source)
            if not isinstance(source, InMemorySource):
                raise InputError("recording.file", "a recording that is streamed", "a CSV or .npz recording")
            source = perturb(source, job.copy_number)
        with watch.taking(0):
            session = build_session(config, source, job.ablation)
        run, lost = _take_steps(session, source, job.pace, watch)
        exm = config.score.experience_metric
        quantities = score_run(run, source.name, exm=exm, relations=relations).quantities
        quantities |= quantity("recognition_error", recognition_error(quantities)) | extra
        quantities |= _closures(session, run.truth, config.pose_cells.cell_size)
        quantities |= quantity("lost_share", Finding(lost))
        for name, finding in anchored_errors(run).items():
            quantities |= quantity(name, finding)
        quantities |= _grid_map(session, source)
    outcome = {"steps": len(run.time), "source": source.digest, "quantities": quantities}
    return outcome | {"measured": watch.times()}


def _take_steps(session: Session, source: Source, pace: str, watch: Stopwatch) -> tuple[RunArrays, float]:
    """The session as arrays, as `evaluation.artifacts.run_reader.read_run` reads one from its files, and
    the share of steps with a lost pose."""
    time, motion, true, estimates = [], [], [], []
    rows, present = read_observations(source), OnlineErrorLog()
    while chunk := list(islice(rows, CHUNK)):
        for part in [chunk] if pace == "replay" else [[row] for row in chunk]:
            with watch.taking(len(part)):
                estimates += list(session.replay([reading for _, reading in part]))
        time += [float(sample.time) for sample, _ in chunk]
        motion += [np.asarray(reading.odometry[:3], float) for _, reading in chunk]
        true += [np.full(3, np.nan) if sample.truth is None else sample.truth for sample, _ in chunk]
        present.update(session, true)
    if not time:
        raise InputError(source.name, "no samples", "a session")
    final, graph, truth = session.map.trajectory(), session.map.graph(), np.array(true)
    nodes = np.array([[row["x"], row["y"], row["heading"]] for _, row in sorted(graph.nodes(data=True))])
    place = np.array([int(step.estimate.place) for step in estimates])
    place = np.where(place < len(nodes), place, -1)
    run = RunArrays(
        time=np.array(time),
        truth=truth if np.isfinite(truth).all(axis=1).any() else None,
        online=np.array([step.pose for step in estimates]),
        final=final,
        odometry=integrate(np.array(motion)),
        experience=place,
        created=np.array([int(np.argmax(place == node)) for node in range(len(nodes))], int),
        nodes=nodes.reshape(-1, 3),
        links=np.array(list(graph.edges), int).reshape(-1, 2),
        online_error=np.array(present.errors),
    )
    return run, float(np.mean([bool(step.estimate.lost) for step in estimates]))


def _closures(session: Session, truth: np.ndarray | None, cell: float) -> dict[str, Quantity]:
    """Number of loop closures and of false ones."""
    closures, false = session.map.closures(), Finding(np.nan)
    if truth is not None:
        apart = np.hypot(*(truth[closures[:, 0]] - truth[closures[:, 1]])[:, :2].T)
        false = Finding(int((apart > SAME_PLACE * cell).sum()))
    return quantity("closures", Finding(len(closures))) | quantity("false_closures", false)


def _grid_map(session: Session, source: Source) -> dict[str, Quantity]:
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
    note = f"0.3 everywhere {error.prior:.3g}, the best constant {error.best:.3g}"
    return quantity("map_error", Finding(error.error, note=note)) | found.quantities


@contextmanager
def _precision(wanted: str) -> Iterator[None]:
    """JAX with the precision of a fresh process, whatever ran in this one before."""
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", wanted == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)
