"""A source through an engine into a run directory, which is scored and drawn at the end."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.artifacts.run_directory import read_run
from evaluation.metrics.energy_metric import read_relations
from evaluation.metrics.scorecard import Scorecard, score_run
from evaluation.metrics.trajectory import OnlineError, current_error, summarize_errors, write_tum
from evaluation.report import plot_writers
from ratslam.backends.registry import BACKENDS, BackendEntry, Sensors, build
from ratslam.config.run_config import RunConfig
from ratslam.config.strict_yaml import dump
from ratslam.core.growable_array import GrowableArray
from ratslam.core.session import CHUNK, Session, Step
from ratslam.core.types import Action
from ratslam.keyframes.ablation import FULL, Ablation
from ratslam.pipeline.artifacts import Felt, keep_chart, keep_images, keep_world
from ratslam.pipeline.run_directory import RunDirectory, read_checkpoint
from robot.sources.source import Sample, Source
from robot.touch_source import observation_of, planar_whiskers_of
from tactile.base.errors import InputError
from tactile.base.se2 import compose, tum_line
from tactile.base.types import Observation

CHECKPOINT_EVERY, CHECKPOINT_SHARE = 128 * CHUNK, 32
"""Steps between checkpoints, at least, and one part in so many of all steps so far: a kill loses no line, but
a continued run repeats at most these. Each holds the whole run: at a fixed distance all would cost O(N^2)."""


class Playing:
    """A source on its way through an engine into a run directory; made by `playing`.

    Attributes:
        session: the engine. skipped: samples of the source that it has seen before.
    """

    def __init__(
        self,
        config: RunConfig,
        source: Source,
        store: RunDirectory,
        manifest: dict[str, Any],
        session: Session,
        skipped: int,
    ) -> None:
        self.session, self.skipped = session, skipped
        self._config, self._source, self._store, self._manifest = config, source, store, manifest
        self._felt: list[Felt] = []
        self._reckoned = np.zeros(3)
        self._truth = GrowableArray((3,), np.float64)
        self._present = Anytimes(session.steps)
        self._saved = session.steps

    def feed(self, samples: list[Sample]) -> list[Step]:
        """The next samples, of one chunk of the session at most, into engine and files."""
        observations = [observation_of(sample) for sample in samples]
        steps = list(self.session.replay(observations))
        self._felt += [(o.view, o.alive) for o in observations] if self._source.whiskers else []
        reckoned = []
        for observation in observations:
            moved = observation.odometry
            self._reckoned = compose(self._reckoned, np.array([moved.dx, moved.dy, moved.dtheta]))
            reckoned.append(self._reckoned)
        for sample in samples:
            self._truth.append(np.nan if sample.truth is None else sample.truth)
        self._store.append(_lines(samples, steps, reckoned, BACKENDS[self._config.backend]))
        error = self._present.see(self.session, self._truth.rows)
        if error is not None:
            self._store.append({"online_error.csv": iter([f"{float(samples[-1].time)!r},{error!r}\n"])})
        if self.session.steps - self._saved >= max(CHECKPOINT_EVERY, self.session.steps // CHECKPOINT_SHARE):
            self._checkpoint()
            self._saved = self.session.steps
        return steps

    def finish(self, interrupted: bool) -> Scorecard:
        """Writes what stands at the end, scores it and draws it.

        Args:
            interrupted: whether there was more to come.
        """
        store, config = self._store, self._config
        self._checkpoint()
        _finish(self.session, store)
        keep_images(self._felt, config.touch, store)
        keep_chart(self._source, store)
        card = score_run(
            read_run(store.path),
            store.path.name,
            exm=config.score.experience_metric,
            relations=read_relations(config.score.relations) if config.score.relations else None,
        )
        store.text("scorecard.json", card.model_dump_json(indent=2) + "\n")
        for name, save in plot_writers(store.path).items():
            store.file(name, save)
        status = "interrupted" if interrupted else "complete"
        store.manifest(self._manifest | {"status": status, "steps": self.session.steps})
        return card

    def _checkpoint(self) -> None:
        self._store.checkpoint(self.session.arrays() | {"digest": np.array(self._source.digest)})


@contextmanager
def playing(
    config: RunConfig, source: Source, directory: Path, resume: Path | None = None
) -> Iterator[Playing]:
    """A new run directory, and a session that has seen nothing, or what a checkpoint holds.

    Args:
        config: completed for the source. source: of observations.

    Raises:
        InputError: the relations, the checkpoint or the run directory cannot be used.
    """
    if config.score.relations:
        read_relations(config.score.relations)  # before there is a directory
    session = session_of(config, source)
    skip = _resume(session, resume, source.digest) if resume else 0
    _check_length(source, skip, resume)
    with RunDirectory(directory, list(BACKENDS[config.backend].columns())) as store:
        text = dump(config)
        store.text("config.yaml", text)
        manifest = _manifest(config, text, source, resume)
        store.manifest(manifest | {"status": "running"})
        keep_world(source, store)
        yield Playing(config, source, store, manifest, session, skip)


def session_of(config: RunConfig, source: Source, ablation: Ablation = FULL) -> Session:
    """A fresh session for what a source gives."""
    sensors = Sensors(source.view_shape, planar_whiskers_of(source, config.touch))
    return Session(
        build(config.backend, config, sensors, config.session.precision, ablation),
        seed=config.session.seed,
        reserve=config.session.reserve,
        precision=config.session.precision,
    )


class Anytimes:
    """How far off the present pose is in the map so far, asked for at the ends of chunks, more seldom as the
    path grows: each answer aligns the whole path.

    Args:
        skipped: steps that the map has folded before.
    """

    def __init__(self, skipped: int = 0) -> None:
        self.errors: list[float] = []
        self._skipped, self._due = skipped, skipped

    def see(self, session: Session, truth: Sequence[np.ndarray] | np.ndarray) -> float | None:
        """The error now, if it is time and the truth [steps, 3] of this moment is known."""
        if session.steps < self._due or session.steps % CHUNK or not np.isfinite(truth[-1]).all():
            return None
        self._due = session.steps + max(CHUNK, session.steps // 256)
        true = np.asarray(truth)
        known = np.isfinite(true).all(axis=1)
        error = current_error(session.map.online_trajectory()[self._skipped :][known], true[known])
        self.errors.append(error)
        return error

    def summary(self) -> OnlineError:
        """Of all answers; NaN without any."""
        return summarize_errors(np.array(self.errors)) if self.errors else OnlineError(np.nan, np.nan, np.nan)


def readings(source: Source) -> Iterator[tuple[Sample, Observation]]:
    """Samples with what an engine is given of each.

    Raises:
        InputError: the source gives whiskers that nobody has made observations of.
    """
    return ((sample, observation_of(sample)) for sample in source)


def _lines(
    samples: list[Sample], steps: list[Step], reckoned: list[np.ndarray], entry: BackendEntry
) -> dict[str, Iterator[str]]:
    rows, columns = list(zip(samples, steps, strict=True)), entry.columns()
    return {
        "steps.csv": (_step_line(sample.time, step, entry, columns) for sample, step in rows),
        "online.tum": (tum_line(sample.time, step.pose) for sample, step in rows),
        "odometry.tum": (tum_line(s.time, pose) for s, pose in zip(samples, reckoned, strict=True)),
        "truth.tum": (tum_line(s.time, s.truth) for s in samples if s.truth is not None),
    }


def _step_line(time: float, step: Step, entry: BackendEntry, columns: Sequence[str]) -> str:
    estimate = step.estimate
    cells = [
        repr(float(time)),
        str(int(estimate.place)),
        Action(int(estimate.action)).name.lower(),
        *(repr(float(value)) for value in (*step.pose, *estimate.spread)),
        str(int(estimate.lost)),
        entry.outcomes(int(step.evidence.outcome)).name.lower(),
        *(_cell(getattr(step.evidence, name)) for name in columns),
    ]
    return ",".join(cells) + "\n"


def _cell(value: Any) -> str:
    if np.issubdtype(value.dtype, np.integer):
        return str(int(value))
    return repr(float(value)) if np.isfinite(value) else ""


def _finish(session: Session, store: RunDirectory) -> None:
    time = np.loadtxt(store.path / "online.tum", usecols=0, ndmin=1)
    final = session.map.trajectory()[session.steps - len(time) :]
    store.file("trajectory.tum", lambda path: write_tum(path, time, final))
    for name, write in session.map.files().items():
        store.file(name, write)


def _resume(session: Session, path: Path, digest: str) -> int:
    """Restores a checkpoint; returns how many samples of this recording it has already seen."""
    arrays = read_checkpoint(path)
    try:
        session.restore(arrays)
    except (ValueError, KeyError) as error:
        raise InputError(str(path), str(error), "a checkpoint made with this configuration") from None
    return session.steps if str(arrays.get("digest", "")) == digest else 0


def _check_length(source: Source, skip: int, resume: Path | None) -> None:
    if source.length is not None and source.length <= skip:
        raise InputError(
            str(resume), f"already holds all {skip} samples of {source.name}", "a run left unfinished"
        )


def _manifest(config: RunConfig, text: str, source: Source, resume: Path | None) -> dict[str, Any]:
    made = source.info.simulation
    packages = ("ratslam", "jax", "jaxlib", "numpy", "scipy", "networkx")
    return {
        "format": "ratslam-run-1",
        "versions": {name: version(name) for name in packages} | {"python": platform.python_version()},
        "machine": platform.machine(),
        "recording": {"name": source.name, "sha256": source.digest, "samples": source.length},
        "simulation": made and made.model_dump(),
        "config_sha256": hashlib.sha256(text.encode()).hexdigest(),
        "seeds": {"session": config.session.seed},
        "continued": resume is not None,
    }
