"""The main loop: processes samples chunk by chunk; writes, scores and plots the result in a run directory.

Observers are told of the progress as plain data. Maps are asked at the end of chunks only, and for what takes
long less and less often: the cost of all questions together stays a small multiple of the last one.
"""

from __future__ import annotations

import hashlib
import json
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.artifacts.run_reader import eight_bit, read_manifest
from evaluation.metrics.energy_metric import read_relations
from evaluation.metrics.metric_registry import build_metrics
from evaluation.metrics.scorecard import Scorecard
from evaluation.metrics.trajectory import read_tum
from ratslam.core.arrays import GrowableArray
from ratslam.core.estimates import Action, GridDrawing, PoseCellActivity
from ratslam.core.session import CHUNK, Session, Step
from ratslam.methods.map_file import NAME, map_file
from ratslam.methods.method_registry import BACKENDS, LOCALISING, BackendEntry
from ratslam.runs.build_session import build_session
from ratslam.runs.cell_recorder import CellRecorder, plan_recording
from ratslam.runs.continuation import checkpoint_of, resume_session
from ratslam.runs.estimate import START, PoseEstimate
from ratslam.runs.map_results import score_and_plot, write_map_results
from ratslam.runs.map_settings import Sensor
from ratslam.runs.run_directory import OnlineErrorLog, RunDirectory, WhiskerView
from ratslam.runs.saved_map import describe_readings, read_map, write_map
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import dump
from robot.recordings.input_judge import judge_motion
from robot.sources.source import Sample, Source
from robot.touch_source import observation_of
from tactile.base.files import temporary_path
from tactile.base.se2 import between, compose, tum_line
from tactile.base.types import Observation
from tactile.whisker_geometry import Head, ur10_head

DRAWN_SHARE = 16
"""The whole map is reported when the run has grown by this part of its steps."""


class RunDescription(NamedTuple):
    """A run, at its beginning.

    Attributes:
        name: of its source. backend: by name.
        head: the whisker head whose images the views are, or None. tallest: obstacle height of brightness 1
            in them, m. pose_cells: whether the method has them.
    """

    name: str
    backend: str
    head: Head | None = None
    tallest: float = 1.0
    pose_cells: bool = False


class StepReport(NamedTuple):
    """One step.

    Attributes:
        number: of the step, from 0. time: s, on the clock of the source. observation: as mapped.
        odometry: [3] dead reckoning from the first step of the run. pose: [3] online, in the map frame.
        place, previous: id of the present place and of the one before, -1 for none. lost: see `Estimate`.
        doubt: probability that the map is worse than odometry, NaN if not judged.
    """

    number: int
    time: float
    observation: Observation
    odometry: np.ndarray
    pose: np.ndarray
    place: int
    previous: int
    lost: bool
    doubt: float


class MapReport(NamedTuple):
    """The map after a step.

    Attributes:
        closures: [n, 3] earlier step, later step and verdict, see `Map.judged_closures`. activity: of the
            pose cells, if the method has them.
        path: [T, 3] all steps in the present map, and grid: the occupancy grid; None where not due.
    """

    closures: np.ndarray
    activity: PoseCellActivity | None
    path: np.ndarray | None = None
    grid: GridDrawing | None = None


Observer = Callable[[RunDescription | tuple[Sequence[StepReport], MapReport | None] | MapReport], None]
"""Is told of a run: its description when its directory is made; the steps of each chunk, with the map at its
end; and the map when it has ended, with the final trajectory as `path`. It must neither raise nor wait: the
run would do so too."""


CHECKPOINT_EVERY, CHECKPOINT_SHARE = 128 * CHUNK, 32
"""Steps between two checkpoints: the first number, or the steps so far divided by the second if that is more,
but at most twice the steps before the first of the two. A run continued after a kill repeats at most these.
The interval grows, because each checkpoint holds the whole run and would make the total cost O(N^2) at a
fixed interval."""


class Runner:
    """Processes the samples of a source; `open_runner` makes one.

    Args:
        estimate: of the last step of a resumed session. warnings: about the input; more may come until the
            end.

    Attributes:
        session: the backend's session. skipped: samples that a resumed session has processed before.
    """

    def __init__(
        self,
        config: RunConfig,
        source: Source,
        directory: RunDirectory,
        manifest: dict[str, Any],
        session: Session,
        skipped: int = 0,
        observers: Sequence[Observer] = (),
        estimate: PoseEstimate = START,
        warnings: Sequence[str] = (),
    ) -> None:
        self.session, self.skipped = session, skipped
        self._warnings = warnings
        self._config, self._source, self._directory, self._manifest = config, source, directory, manifest
        self._views: list[WhiskerView] = []
        self._images: list[np.ndarray | None] = []  # of the views, for those that closures join
        self._odometry_pose = np.zeros(3)
        self._truth = GrowableArray((3,), np.float64)
        self._online_error = OnlineErrorLog(session.steps)
        self._begun = self._saved = session.steps
        self._estimate, self._readings = estimate, describe_readings(source)
        plan = plan_recording(config, source, session.backend)
        self._cells = None if plan is None else CellRecorder(directory.path, plan)
        self._observers, self._drawn_at = observers, session.steps  # when the whole map is due
        if observers:
            head = ur10_head(config.touch.head) if source.info.planar_whiskers is None else None
            if head is not None and source.whiskers != len(head.length):
                head = None
            cells = session.backend.activity(session.state) is not None
            run = RunDescription(source.name, config.backend, head, config.touch.image.tallest, cells)
        for observe in observers:
            observe(run)

    def process(self, samples: list[Sample]) -> list[Step]:
        """Maps the next samples, up to one chunk of the session, and appends them to the files."""
        observations = [observation_of(sample) for sample in samples]
        began = time.perf_counter()
        steps = list(self.session.replay(observations))
        took = time.perf_counter() - began
        if self._cells is not None:
            self._cells.add(samples, steps)
        self._views += [(o.view, o.alive) for o in observations] if self._source.whiskers else []
        self._images += [eight_bit(o.view) if bool(o.view_seen) else None for o in observations]
        odometry = []
        for sample, observation in zip(samples, observations, strict=True):
            self._odometry_pose = compose(self._odometry_pose, np.array(observation.odometry[:3], float))
            odometry.append(self._odometry_pose)
            self._truth.append(np.nan if sample.truth is None else sample.truth)
        entry = BACKENDS.get(self._config.backend, "backend")
        self._directory.append(_lines(samples, steps, odometry, entry))
        self._estimate = PoseEstimate.of_step(steps[-1], entry.outcome(steps[-1].evidence))
        self._directory.append({"timing.csv": f"{self.session.steps},{len(steps)},{took:.6f}\n"})
        error = self._online_error.update(self.session, self._truth.rows)
        if error is not None:
            self._directory.append({"online_error.csv": f"{float(samples[-1].time)!r},{error!r}\n"})
        longest = max(CHECKPOINT_EVERY, self.session.steps // CHECKPOINT_SHARE)
        if self.session.steps - self._saved >= min(longest, max(CHUNK, 2 * (self._saved - self._begun))):
            self.checkpoint()
        if self._observers:
            self._report(samples, observations, steps, odometry)
        return steps

    def finish(self, interrupted: bool) -> Scorecard:
        """Writes the final results, scores and plots them.

        The scores are those of the files, read back with the function that `ratslam score` uses: so a run
        directory that is scored later, or one of a killed run, gives the same numbers.

        Args:
            interrupted: whether the source has more samples.
        """
        status = "interrupted" if interrupted else "complete"
        file = self._directory.path / NAME
        # Of a complete run it appears last: after a kill before, there are samples to go on with.
        written = file if interrupted else temporary_path(file)
        self._write_map(written, compressed=True)  # before a solution moves poses
        try:
            card = self._write_results()
        finally:
            written.replace(file)
        self._write_manifest(status=status, steps=self.session.steps)
        made = self.session.map
        for observe in self._observers:
            observe(self._map_report()._replace(path=made.trajectory(), grid=made.grid()))
        return card

    def checkpoint(self) -> None:
        """Writes the map file."""
        self._write_map(self._directory.path / NAME, compressed=False)
        self._saved = self.session.steps

    def _write_map(self, path: Path, compressed: bool) -> None:
        write_map(
            path, self.session, self._config, self._readings,
            recording=self._source.digest, estimate=self._estimate, compressed=compressed,
        )  # fmt: skip

    def _write_results(self) -> Scorecard:
        directory, config = self._directory, self._config
        time = np.loadtxt(directory.path / "online.tum", usecols=0, ndmin=1)
        write_map_results(directory.path, self.session.map, time)
        if self._cells is not None:
            self._cells.finish()
        directory.save_whisker_views(self._views, config.touch)
        directory.save_closure_views(self._images)
        directory.save_grid_map()
        directory.save_changes(self.session.map, config.touch)
        self._judge_input()
        return score_and_plot(directory.path, config.score)

    def _judge_input(self) -> None:
        """Writes the verdict on the input to the manifest; judges the motion of what is no recording."""
        found = list(self._warnings)
        if self._config.recording is None or not self._source.digest:  # of a live session none was read yet
            time, poses = read_tum(self._directory.path / "odometry.tum")
            moved = between(np.concatenate([np.zeros((1, 3)), poses[:-1]]), poses)
            motion = np.column_stack([moved, np.diff(time, prepend=time[:1])])
            found += judge_motion(time, motion, self._source.name, self._source.info.interval)
        self._write_manifest(input=_input(found))

    def _write_manifest(self, **changed: Any) -> None:
        self._manifest |= changed
        self._directory.text("manifest.json", _manifest_text(self._manifest))

    def _report(
        self,
        samples: list[Sample],
        observations: list[Observation],
        steps: list[Step],
        odometry: list[np.ndarray],
    ) -> None:
        """Tells the observers of these steps, and at the end of a chunk of the map."""
        count = self.session.steps
        rows = zip(samples, observations, steps, odometry, strict=True)
        reports = [
            StepReport(
                number=number,
                time=float(sample.time),
                observation=observation,
                odometry=dead_reckoned,
                pose=np.asarray(step.pose, float),
                place=int(step.estimate.place),
                previous=int(step.estimate.previous),
                lost=bool(step.estimate.lost),
                doubt=float(step.doubt),
            )
            for number, (sample, observation, step, dead_reckoned) in enumerate(rows, count - len(steps))
        ]
        report = None
        if count % CHUNK == 0:
            report = self._map_report()
            if count >= self._drawn_at:
                self._drawn_at = count + count // DRAWN_SHARE
                made = self.session.map
                report = report._replace(path=made.online_trajectory(), grid=made.grid())
        for observe in self._observers:
            observe((reports, report))

    def _map_report(self) -> MapReport:
        session = self.session
        return MapReport(session.map.judged_closures(), session.backend.activity(session.state))


@contextmanager
def open_runner(
    config: RunConfig,
    source: Source,
    directory: Path,
    resume: Path | None = None,
    session: Session | None = None,
    observers: Sequence[Observer] = (),
    warnings: list[str] | None = None,
) -> Iterator[Runner]:
    """A runner with a new run directory.

    Args:
        config: completed for the source. source: of observations. directory: its path.
        resume: map to restore the session from, a run directory or a file.
        session: one that `build_session` has made for them before; None makes it.
        observers: are told of the progress; results are the same with and without. warnings: about the
            input; more may come until the end.

    Raises:
        InputError: the relations, the map or the run directory cannot be used.
    """
    if config.score.relations:
        read_relations(config.score.relations)  # fails before the directory is created
    build_metrics(config.score.metrics)
    check_finished_map(config, source)
    session = session or build_session(config, source)
    begun = None if resume is None else checkpoint_of(resume)
    skip, estimate = (0, START) if begun is None else resume_session(session, begun, config, source)
    text = dump(config)
    warnings = [] if warnings is None else warnings  # a reader goes on to add to it
    if begun is not None and map_file(begun).name == NAME:  # of a run
        warnings[:0] = read_manifest(map_file(begun).parent).warnings
    manifest = _manifest(config, text, source) | {"continued": begun is not None, "first_step": session.steps}
    manifest |= {"input": _input(warnings), "status": "running"}
    columns = BACKENDS.get(config.backend, "backend").columns()
    with RunDirectory(directory, columns, _manifest_text(manifest)) as files:
        files.text("config.yaml", text)
        files.save_world(source.info)
        runner = Runner(config, source, files, manifest, session, skip, observers, estimate, warnings)
        if begun is not None:
            runner.checkpoint()  # nothing else of this folder holds the map before
        yield runner


def _lines(
    samples: list[Sample], steps: list[Step], odometry: list[np.ndarray], entry: BackendEntry
) -> dict[str, list[str]]:
    """The lines of the text files of a run, by their names."""
    rows = []
    for sample, step in zip(samples, steps, strict=True):
        estimate = step.estimate
        cells = [
            repr(float(sample.time)),
            str(int(estimate.place)),
            Action(int(estimate.action)).name.lower(),
            *(repr(float(value)) for value in (*step.pose, *estimate.spread)),
            str(int(estimate.lost)),
            _cell(np.asarray(step.doubt)),
            entry.outcome(step.evidence),
            *(_cell(getattr(step.evidence, name)) for name in entry.columns()),
        ]
        rows.append(",".join(cells) + "\n")
    return {
        "steps.csv": rows,
        "online.tum": [tum_line(s.time, step.pose) for s, step in zip(samples, steps, strict=True)],
        "odometry.tum": [tum_line(s.time, pose) for s, pose in zip(samples, odometry, strict=True)],
        "truth.tum": [tum_line(s.time, s.truth) for s in samples if s.truth is not None],
    }


def _cell(value: Any) -> str:
    if np.issubdtype(value.dtype, np.integer):
        return str(int(value))
    return repr(float(value)) if np.isfinite(value) else ""


def check_finished_map(config: RunConfig, source: Source) -> None:
    """Raises `InputError` if the source cannot be localised in the map that the configuration names, because
    the map is broken or of another sensor."""
    if config.backend in LOCALISING.values() and config.localise.map is not None:
        saved = read_map(config.localise.map)
        saved.sensor.check_same(str(saved.path), Sensor.of(config, source))


def _manifest_text(content: dict[str, Any]) -> str:
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def _input(warnings: Sequence[str]) -> dict[str, Any]:
    return {"verdict": "warned" if warnings else "clean", "warnings": list(dict.fromkeys(warnings))}


def _manifest(config: RunConfig, text: str, source: Source) -> dict[str, Any]:
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
    }
