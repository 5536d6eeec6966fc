"""One job: a session played in memory, judged, timed and weighed."""

from __future__ import annotations

import hashlib
import platform
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Any

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
from ratslam.experiments.studies.memory import weighed
from ratslam.experiments.studies.results import Machine, Result, Timing
from ratslam.experiments.studies.study import Job
from ratslam.experiments.studies.timing import Stopwatch
from ratslam.pipeline.artifacts import true_grid
from ratslam.pipeline.online_error import OnlineErrorLog
from ratslam.pipeline.runner import build_session
from ratslam.pipeline.source import open_observations, read_observations
from robot.sources.source import Source
from robot.world.arena import read_arena
from tactile.base.errors import InputError
from tactile.base.se2 import integrate

PACKAGES = ("ratslam", "tactile", "robot", "evaluation")


def run_job(job: Job) -> Result:
    """Runs a job in this process. What a user can mend is told in the result, so that a study goes on."""
    blank = Result(hash=job.hash, seed=job.seed, row=job.row, varied=job.varied, machine=machine())
    try:
        with _precision(job.config.session.precision), weighed() as memory:
            found = _played(job.config, job.pace)
    except InputError as error:
        return blank.model_copy(update={"error": str(error)})
    return blank.model_copy(update=found | {"memory": memory()})


@lru_cache(maxsize=1)
def machine() -> Machine:
    """This one."""
    device = jax.devices()[0]
    return Machine(
        processor=_processor(),
        device="cpu" if device.platform == "cpu" else device.device_kind,
        versions={name: version(name) for name in ("jax", "jaxlib", "numpy")}
        | {"python": platform.python_version()},
        build=build(),
    )


@lru_cache(maxsize=1)
def build() -> str:
    """The beginning of the sha256 of all our code: what was made by other code may come out otherwise."""
    total = hashlib.sha256()
    for name in PACKAGES:
        folder = Path(str(sys.modules[name].__file__)).parent
        for path in sorted(folder.rglob("*.py")):
            total.update(f"{name}/{path.relative_to(folder).as_posix()}\n".encode() + path.read_bytes())
    return total.hexdigest()[:12]


def _played(config: RunConfig, pace: str) -> dict[str, Any]:
    """The fields of a result that come of playing a configuration."""
    began = perf_counter()
    relations = read_relations(config.score.relations) if config.score.relations else None
    with open_observations(config) as (config, source):
        watch = Stopwatch()
        with watch.preparing():
            session = build_session(config, source)
        time, motion, truth, told, places = [], [], [], [], []
        present = OnlineErrorLog()
        rows = read_observations(source)
        while chunk := list(islice(rows, CHUNK)):
            steps = []
            for part in [chunk] if pace == "replay" else [[row] for row in chunk]:
                with watch.taking(len(part)):
                    steps += list(session.replay([reading for _, reading in part]))
            time += [float(sample.time) for sample, _ in chunk]
            motion += [np.asarray(reading.odometry[:3], float) for _, reading in chunk]
            truth += [np.full(3, np.nan) if sample.truth is None else sample.truth for sample, _ in chunk]
            told += [step.pose for step in steps]
            places += [int(step.estimate.place) for step in steps]
            present.update(session, truth)
        if not time:
            raise InputError(source.name, "no samples", "a session")
        with watch.finishing():
            final = session.map.trajectory()
        run = _run(session, np.array(time), np.array(motion), np.array(truth), np.array(told), final, places)
        card = score_run(
            run._replace(online_error=np.array(present.errors)),
            source.name,
            exm=config.score.experience_metric,
            relations=relations,
        )
        quantities = card.quantities | _chart(session, source)
    timing = Timing(pace=pace, **watch.told(), total_s=perf_counter() - began)
    return {"steps": len(time), "source": source.digest, "quantities": quantities, "timing": timing}


def _run(
    session: Session,
    time: np.ndarray,
    motion: np.ndarray,
    truth: np.ndarray,
    told: np.ndarray,
    final: np.ndarray,
    places: list[int],
) -> RunArrays:
    """The session as arrays, as `evaluation.artifacts.run_directory.read_run` reads one from its files."""
    graph = session.map.graph()
    nodes = np.array([[row["x"], row["y"], row["heading"]] for _, row in sorted(graph.nodes(data=True))])
    nodes = nodes.reshape(-1, 3)
    place = np.array(places)
    place = np.where(place < len(nodes), place, -1)
    return RunArrays(
        time=time,
        truth=truth if np.isfinite(truth).all(axis=1).any() else None,
        online=told,
        final=final,
        odometry=integrate(motion),
        experience=place,
        created=np.array([int(np.argmax(place == node)) for node in range(len(nodes))], int),
        nodes=nodes,
        links=np.array(list(graph.edges), int).reshape(-1, 2),
    )


def _chart(session: Session, source: Source) -> dict[str, Quantity]:
    """What is measured on a map that is a grid, of an arena that is known."""
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
    """JAX as a fresh process of that precision has it, whatever ran in this one before."""
    before = jax.config.read("jax_enable_x64")
    jax.config.update("jax_enable_x64", wanted == "float64")
    try:
        yield
    finally:
        jax.config.update("jax_enable_x64", before)


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
