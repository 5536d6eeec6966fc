"""Runs of a study: a session is played in memory, scored and timed, and its record is kept.

`runs.jsonl` holds one record a line; a job whose record is there is not run again. Jobs run in the processes
of an executor, or, where their speed is compared, one at a time on one core.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from functools import partial
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import jax
import numpy as np
from pydantic import Field

from evaluation.artifacts.grid_files import read_grid
from evaluation.metrics.energy_metric import read_relations
from evaluation.metrics.metric import Finding, Quantity
from evaluation.metrics.occupancy_score import MAIN_CONVENTION, score_grid
from evaluation.metrics.run_metrics import RunArrays, anchored_errors, recognition_error
from evaluation.metrics.scorecard import score_run
from evaluation.studies.executor import Executor
from evaluation.studies.machine import Machine, Stopwatch, machine, one_core, watch_machine
from evaluation.studies.metrics import closure_errors, quantities_of
from evaluation.studies.perturbation import perturb
from evaluation.studies.scene_statistics import compare_with_tier
from evaluation.studies.study import Job, run_key
from ratslam.core.session import CHUNK, Session
from ratslam.runs.build_session import build_session, open_observations, read_observations
from ratslam.runs.run_directory import OnlineErrorLog, true_grid
from robot.sources.in_memory import InMemorySource, load_into_memory
from robot.sources.source import Source
from robot.world.arena import read_arena
from tactile.base.errors import InputError, os_errors_of
from tactile.base.se2 import integrate
from tactile.base.settings import Settings

Record = TypeVar("Record", bound=Settings)
FILE = "runs.jsonl"  # name of the file of records in a study's directory


class RunRecord(Settings):
    """Outcome of one run. `quantities` and `steps` do not depend on the machine; the rest does."""

    hash: str  # hash of the configuration without its seed
    seed: int  # seed of the simulation or session
    copy_number: int = 0  # seed of the perturbed copy of the session; 0: the session itself
    row: str = ""  # name of the study's row
    varied: dict[str, Any] = Field(default_factory=dict)  # combination of the varied settings, by key path
    steps: int = 0  # number of observations
    source: str = ""  # digest of the session
    quantities: dict[str, Quantity] = Field(default_factory=dict)  # scored quantities by name
    measured: dict[str, float | None] = Field(default_factory=dict)  # by names of `metrics.MEASURED`
    machine: Machine | None = None  # where it was computed
    error: str | None = None  # why there is no outcome

    @property
    def key(self) -> str:
        """Identifies the run: two runs with one key are the same."""
        return run_key(self.hash, self.seed, self.copy_number)

    def value(self, name: str) -> float | None:
        """A quantity by its name in `metrics.METRICS`; None if the run has none."""
        return self.quantities[name].value if name in self.quantities else self.measured.get(name)

    def odometry(self, name: str) -> float | None:
        """A quantity of raw odometry; None if the run has none."""
        return self.quantities[name].odometry if name in self.quantities else None


def _record_of(job: Job, error: str | None = None, machine: Machine | None = None) -> RunRecord:
    """The record of a job without an outcome."""
    names = {name: getattr(job, name) for name in ("hash", "seed", "copy_number", "row", "varied")}
    return RunRecord(**names, error=error, machine=machine)


def read_records(path: Path, record: type[Record]) -> list[Record]:
    """The records in a file, one a line, without a line that a kill cut off; none without the file."""
    found = []
    for line in path.read_bytes().splitlines() if path.exists() else []:
        with suppress(ValueError):
            found.append(record.model_validate_json(line))
    return found


class RunLog:
    """The records in a directory. A kill loses at most the record that was being written.

    Args:
        directory: is created if missing; an `InputError` says that it cannot be.
    """

    def __init__(self, directory: Path) -> None:
        with os_errors_of(directory, "cannot be made", "a folder to write to"):
            directory.mkdir(parents=True, exist_ok=True)
        self.path = directory / FILE
        self.records = {record.key: record for record in read_records(self.path, RunRecord)}

    def append(self, record: RunRecord) -> None:
        """Adds a record; it is on disk when this returns."""
        with self.path.open("ab+") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 1, 0))
            cut_off = size > 0 and file.read(1) != b"\n"
            # One write: two studies may append to one file.
            file.write(b"\n" * cut_off + record.model_dump_json().encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        self.records[record.key] = record


SAME_PLACE = 2.5  # largest true distance between the ends of a true loop closure, pose cells


def run_job(job: Job, kernels: Path | None = None) -> RunRecord:
    """Runs a job in this process. An `InputError` is recorded, so that the study continues.

    Args:
        kernels: folder in which compiled kernels are kept, for each configuration its own.
    """
    if kernels is not None:
        jax.config.update("jax_compilation_cache_dir", str(kernels / job.hash))
    watched = watch_machine()
    try:
        with _precision(job.config.session.precision):
            found = _play(job)
    except InputError as error:
        return _record_of(job, str(error), machine())
    memory, here = watched()
    measured = found["measured"] | {"memory": memory}
    return _record_of(job).model_copy(update=found | {"measured": measured, "machine": here})


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
        quantities |= quantities_of({"recognition_error": recognition_error(quantities)}) | extra
        closures, false = session.map.closures(), np.nan
        if run.truth is not None:
            apart = closure_errors(run.truth, closures)
            false = int((apart > SAME_PLACE * config.pose_cells.cell_size).sum())
        counts = {"closures": len(closures), "false_closures": false, "lost_share": lost}
        findings = {name: Finding(value) for name, value in counts.items()} | anchored_errors(run)
        quantities |= quantities_of(findings) | _grid_map(session, source)
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


def _grid_map(session: Session, source: Source) -> dict[str, Quantity]:
    """Scores of a grid map of a known arena."""
    write, arena = session.map.files().get("grid.npz"), source.info.arena
    if write is None or arena is None:
        return {}
    with TemporaryDirectory() as name:
        folder = Path(name)
        write(folder / "grid.npz")
        (folder / "arena.txt").write_text(arena, encoding="utf-8")
        grid = read_grid(folder / "grid.npz")
        found = score_grid(grid, true_grid(read_arena(folder / "arena.txt"), grid))
    error = found.under(MAIN_CONVENTION)
    note = f"0.3 everywhere {error.prior:.3g}, the best constant {error.best:.3g}"
    return quantities_of({"map_error": Finding(error.error, note=note)}) | found.quantities


@contextmanager
def _precision(wanted: str) -> Iterator[None]:
    """JAX with the precision of a fresh process, whatever ran in this one before."""
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", wanted == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


KILLED = "its process was killed, for lack of memory for example"
Done = Callable[[RunRecord], object]


def run_jobs(
    jobs: Sequence[Job],
    log: RunLog,
    executor: Executor,
    done: Done | None = None,
    function: Callable[[Job], RunRecord] | None = None,
) -> Iterator[RunRecord]:
    """Yields the records of all jobs in their order; each is on disk before.

    Args:
        log: records of earlier calls; new ones are added, except of a killed process: the next call runs its
            job again. done: called with each record in the order of completion, once for each key.
        function: runs a job; default `run_job`.
    """
    found, done = dict(log.records), done or (lambda record: None)
    killed = partial(_record_of, error=KILLED)
    wanted: dict[str, Job] = {}
    for job in jobs:
        wanted.setdefault(job.key, job)
    missing = [job for key, job in wanted.items() if key not in found]
    for key in filter(found.get, wanted):
        done(_labelled(found[key], wanted[key]))
    with closing(executor.completed(function or run_job, missing, killed)) as completed:
        for job in jobs:
            while job.key not in found:
                _, record = next(completed)
                if record.error != KILLED:
                    ran = record.machine and record.machine.model_copy(update={"workers": executor.processes})
                    record = record.model_copy(update={"machine": ran})
                    log.append(record)
                found[record.key] = record
                done(_labelled(record, wanted[record.key]))
            yield _labelled(found[job.key], job)


def measure_jobs(jobs: Sequence[Job], log: RunLog, done: Done | None = None) -> list[RunRecord]:
    """The records of all jobs, measured one at a time on one core, each in a process of its own.

    Jobs run seed by seed, so that a disturbance of the machine spreads over all configurations. Only the
    first run of a configuration compiles its kernels.
    """
    order = sorted(range(len(jobs)), key=lambda k: (jobs[k].seed, jobs[k].copy_number))
    with TemporaryDirectory(ignore_cleanup_errors=True) as kernels, one_core(), Executor(fresh=True) as fresh:
        alone = partial(run_job, kernels=Path(kernels))
        records = dict(zip(order, run_jobs([jobs[k] for k in order], log, fresh, done, alone), strict=True))
    return [records[k] for k in range(len(jobs))]


def _labelled(record: RunRecord, job: Job) -> RunRecord:
    """The record under this job's row: several rows may have the same configuration."""
    return record.model_copy(update={"row": job.row, "varied": job.varied})
