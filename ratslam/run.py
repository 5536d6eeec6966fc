"""The main job: a recording or a simulated session through an engine into a run directory."""

from __future__ import annotations

import hashlib
import platform
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from evaluation.energy import read_relations
from evaluation.report import pictures
from evaluation.rundirectory import read_run
from evaluation.scorecard import Scorecard, score
from evaluation.trajectory import Anytime, present_error, summary, write_tum
from ratslam.backends import Telling, backend_of, telling
from ratslam.config import RunConfig
from ratslam.growing import Growing
from ratslam.keeping import Felt, keep_chart, keep_images, keep_world
from ratslam.session import CHUNK, Session, Step
from ratslam.storage import RunDirectory, read_checkpoint
from ratslam.types import Action
from ratslam.yamlfile import dump
from robot.formats import open_recording
from robot.recorder import Recorder
from robot.roving import roving
from robot.sensing import calibration_of, feelers_of, observation_of, sensing
from robot.simulation import simulated
from robot.source import Sample, Source, rig_of
from tactile.errors import InputError
from tactile.frames import compose, tum_line
from tactile.frontend import Frontend
from tactile.types import Cycle, Observation, Whisk

CHECKPOINT_EVERY, CHECKPOINT_SHARE = 128 * CHUNK, 32
"""Steps between checkpoints, at least, and one part in so many of all steps so far: a kill loses no line, but
a continued run repeats at most these. Each holds the whole run: at a fixed distance all would cost O(N^2)."""


def run(
    config: RunConfig, folder: Path, directory: Path, resume: Path | None = None
) -> tuple[Scorecard, bool]:
    """Runs and scores.

    Args:
        folder: of the configuration file; relative paths start there. resume: a checkpoint to go on from.

    Returns:
        the scorecard, and whether the run was interrupted (its outputs are then of the part done).

    Raises:
        InputError: the recording, the simulation, the checkpoint or the run directory cannot be used.
        OSError: the disk is full.
    """
    config = located(config, folder.resolve())
    relations = read_relations(config.score.relations) if config.score.relations else None
    with open_source(config, _tell) as source:
        config = config.completed(source)
        source = sensing(source, config.touch)
        session = session_of(config, source)
        skip = _resume(session, resume, source.digest) if resume else 0
        _check_length(source, skip, resume)
        told = telling(config)
        with RunDirectory(directory, list(told.columns)) as store:
            text = dump(config)
            store.text("config.yaml", text)
            manifest = _manifest(config, text, source, resume)
            store.manifest(manifest | {"status": "running"})
            keep_world(source, store)
            felt: list[Felt] = []
            interrupted = _play(session, source, skip, store, felt, told)
            done = {"status": "interrupted" if interrupted else "complete", "steps": session.steps}
            _finish(session, store, source.digest)
            keep_images(felt, config.touch, store)
            keep_chart(source, store)
            card = score(
                read_run(directory), directory.name, exm=config.score.experience_metric, relations=relations
            )
            store.text("scorecard.json", card.model_dump_json(indent=2) + "\n")
            for name, save in pictures(directory).items():
                store.file(name, save)
            store.manifest(manifest | done)
    return card, interrupted


def simulate(config: RunConfig, folder: Path, path: Path) -> tuple[int, bool]:
    """Writes the simulated session of a configuration to a recording: what each whisker felt, or its samples.

    Returns:
        how many whisks were written, and whether the user interrupted.

    Raises:
        InputError: there is nothing to simulate, it cannot be simulated, or the file exists.
    """
    config = located(config, folder.resolve())
    if config.simulation is None and config.roving is None:
        raise InputError("simulation", "missing", "what to simulate", "`simulation: {}` is a whole session")
    source = open_source(config, _tell)
    keep = _kept(config, source)
    recorder = recorder_of(path, source)
    bar = tqdm(source, unit="whisk", desc=source.name, file=sys.stderr, mininterval=0.5, total=source.length)
    with recorder, bar, _interrupts("closing the file") as interrupted:
        for sample in bar:
            recorder.write(keep(sample))
            if interrupted():
                break
        return recorder.count, interrupted()


def recorder_of(path: Path, source: Source) -> Recorder:
    """What records a source, a chunk of the session's at a time.

    Raises:
        InputError: the file exists or cannot be made.
    """
    return Recorder(
        path,
        view_shape=source.view_shape,
        whiskers=source.whiskers,
        rate_hz=source.rate_hz,
        rig=rig_of(source),
        chunk_s=CHUNK / (source.rate_hz or 1.0),
    )


def _kept(config: RunConfig, source: Source) -> Callable[[Sample], Sample]:
    """What of a simulated sample goes into a recording: what whiskers felt, unless raw samples are wanted."""
    if config.simulation is None or config.simulation.raw:
        return lambda sample: sample
    frontend = Frontend(config.touch, calibration_of(source))

    def felt(sample: Sample) -> Sample:
        if not isinstance(sample.reading, Cycle | Whisk):
            return sample
        return sample._replace(reading=frontend.felt(sample.reading))

    return felt


def open_source(config: RunConfig, tell: Callable[[str], None] | None = None) -> Source:
    """The recording of a configuration with whole paths, or its simulated session.

    Args:
        tell: called with one sentence on how much is simulated and why, or if only a part of a recording
            could be read.

    Raises:
        InputError: it cannot be read, or not be simulated.
    """
    if config.roving is not None:
        return roving(config.roving)
    if config.simulation is not None:
        session = simulated(config.simulation, config.touch.head)
        if tell is not None:
            tell(f"simulating in the {session.tier.name} tier: {session.tier.why}")
        return session
    assert config.recording is not None
    return open_recording(config.recording, tell and (lambda sentence: tell(f"warning: {sentence}")))


def session_of(config: RunConfig, source: Source) -> Session:
    """A fresh session for what a source gives."""
    return Session(
        backend_of(config, source.view_shape, feelers_of(source, config.touch)),
        seed=config.session.seed,
        reserve=config.session.reserve,
        precision=config.session.precision,
    )


def located(config: RunConfig, folder: Path) -> RunConfig:
    """The configuration with whole paths, so that the copy in the run directory can be run again."""
    judgement = config.score
    if judgement.relations:
        judgement = judgement.model_copy(update={"relations": folder / judgement.relations})
    parts = {
        "recording": config.recording and config.recording.resolved(folder),
        "simulation": config.simulation and config.simulation.resolved(folder),
        "roving": config.roving and config.roving.resolved(folder),
        "touch": config.touch.model_copy(update={"reports": config.touch.reports.resolved(folder)}),
    }
    return config.model_copy(update={**parts, "score": judgement})


def _play(
    session: Session, source: Source, skip: int, store: RunDirectory, felt: list[Felt], told: Telling
) -> bool:
    """Replays the source into the store; returns whether the user interrupted.

    Args:
        felt: the image of each whisk is added to it.
    """
    samples = islice(iter(source), skip, None)
    odometry = np.zeros(3)
    truth = Growing((3,), np.float64)
    present = Anytimes(session.steps)
    total = None if source.length is None else source.length - skip
    saved = session.steps
    bar = tqdm(total=total, unit="step", desc=source.name, file=sys.stderr, mininterval=0.5)
    last = "finishing this chunk and writing the results"
    with bar as progress, _interrupts(last) as interrupted:
        while not interrupted() and (chunk := list(islice(samples, CHUNK - session.steps % CHUNK))):
            observations = [observation_of(sample) for sample in chunk]
            steps = list(session.replay(observations))
            felt += [(o.view, o.alive) for o in observations] if source.whiskers else []
            reckoned = []
            for observation in observations:
                moved = observation.odometry
                odometry = compose(odometry, np.array([moved.dx, moved.dy, moved.dtheta]))
                reckoned.append(odometry)
            for sample in chunk:
                truth.append(np.nan if sample.truth is None else sample.truth)
            store.append(_lines(chunk, steps, reckoned, told))
            error = present.see(session, truth.rows)
            if error is not None:
                store.append({"anytime.csv": iter([f"{float(chunk[-1].time)!r},{error!r}\n"])})
            if session.steps - saved >= max(CHECKPOINT_EVERY, session.steps // CHECKPOINT_SHARE):
                store.checkpoint(session.arrays() | {"digest": np.array(source.digest)})
                saved = session.steps
            progress.update(len(chunk))
            progress.set_postfix(places=int(steps[-1].estimate.place) + 1, refresh=False)
        return interrupted()


@contextmanager
def _interrupts(last: str) -> Iterator[Callable[[], bool]]:
    """Says whether the user has pressed Ctrl-C, which waits for the chunk at work; twice does not wait.

    Args:
        last: what is still done then.
    """
    pressed: list[int] = []

    def press(number: int, frame: Any) -> None:
        if pressed:
            raise KeyboardInterrupt
        pressed.append(number)
        print(f"\nratslam: interrupted; {last} ...", file=sys.stderr)

    before = signal.signal(signal.SIGINT, press)
    try:
        yield lambda: bool(pressed)
    finally:
        signal.signal(signal.SIGINT, before)


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
        error = present_error(session.map.so_far()[self._skipped :][known], true[known])
        self.errors.append(error)
        return error

    def summary(self) -> Anytime:
        """Of all answers; NaN without any."""
        return summary(np.array(self.errors)) if self.errors else Anytime(np.nan, np.nan, np.nan)


def readings(source: Source) -> Iterator[tuple[Sample, Observation]]:
    """Samples with what an engine is given of each.

    Raises:
        InputError: the source gives whiskers that nobody has made observations of.
    """
    return ((sample, observation_of(sample)) for sample in source)


def _lines(
    samples: list[Sample], steps: list[Step], reckoned: list[np.ndarray], told: Telling
) -> dict[str, Iterator[str]]:
    rows = list(zip(samples, steps, strict=True))
    return {
        "steps.csv": (_step_line(sample.time, step, told) for sample, step in rows),
        "online.tum": (tum_line(sample.time, step.pose) for sample, step in rows),
        "odometry.tum": (tum_line(s.time, pose) for s, pose in zip(samples, reckoned, strict=True)),
        "truth.tum": (tum_line(s.time, s.truth) for s in samples if s.truth is not None),
    }


def _step_line(time: float, step: Step, told: Telling) -> str:
    estimate = step.estimate
    cells = [
        repr(float(time)),
        str(int(estimate.place)),
        Action(int(estimate.action)).name.lower(),
        *(repr(float(value)) for value in (*step.pose, *estimate.spread)),
        str(int(estimate.lost)),
        told.outcomes(int(step.evidence.outcome)).name.lower(),
        *(_cell(getattr(step.evidence, name)) for name in told.columns),
    ]
    return ",".join(cells) + "\n"


def _cell(value: Any) -> str:
    if np.issubdtype(value.dtype, np.integer):
        return str(int(value))
    return repr(float(value)) if np.isfinite(value) else ""


def _finish(session: Session, store: RunDirectory, digest: str) -> None:
    store.checkpoint(session.arrays() | {"digest": np.array(digest)})
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
    made = rig_of(source).get("simulation", {})
    packages = ("ratslam", "jax", "jaxlib", "numpy", "scipy", "networkx")
    return {
        "format": "ratslam-run-1",
        "versions": {name: version(name) for name in packages} | {"python": platform.python_version()},
        "machine": platform.machine(),
        "recording": {"name": source.name, "sha256": source.digest, "samples": source.length},
        "simulation": {name: made.get(name) for name in ("sha256", "seed", "tier", "why")} if made else None,
        "config_sha256": hashlib.sha256(text.encode()).hexdigest(),
        "seeds": {"session": config.session.seed},
        "continued": resume is not None,
    }


def _tell(sentence: str) -> None:
    print(f"ratslam: {sentence}", file=sys.stderr)
