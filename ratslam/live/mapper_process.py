"""The mapper in a separate process: receives samples as they come and returns a report for each.

The process that controls the robot never waits for it, and a fault in one does not end the other: without its
parent, the mapper completes the run directory with the samples so far.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import queue
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import numpy as np

from evaluation.metrics.scorecard import Scorecard
from ratslam.runs.settings.run_config import RunConfig
from robot.drivers.processes import step_back, withheld_signals
from robot.live.map_publisher import Drawing
from robot.recordings.cdr import PIECE
from robot.sources.source import ClosedSource, Sample, SourceDescription
from tactile.base.errors import InputError
from tactile.calibration import Calibration

LOG = "mapper.log"
"""Log of the mapper process, in the run directory."""
MOST_DRAWN = 1000
"""Poses of a drawn path, about."""
FINISH_TIMEOUT = 120.0
"""Time without a result after which the mapper is given up at the end; scoring and plotting give none, s."""


class MappingJob(NamedTuple):
    """Input of the mapper before the first sample.

    Attributes:
        config: its `recording` is the file that the session is recorded to.
        source: as in that file, without the calibration, which follows. directory: the new run directory.
        extent_m: largest distance from the start along x or y on the planned path, m.
        view: target of a live view, or None. resume: map to continue, or None.
        draws: whether the map as a whole is sent from time to time.
    """

    config: RunConfig
    source: SourceDescription
    directory: Path
    extent_m: float
    view: str | None = None
    resume: Path | None = None
    draws: bool = False


class MappedSample(NamedTuple):
    """The result of a sample.

    Attributes:
        number: of the sample; a front end may add the motion of one to the next, which then has no result.
            pose: [3] online, in the map frame (m, m, rad), and spread: [3] its standard deviations.
            place: -1 for none. seconds: computing time.
            doubt: see `ratslam.core.session.Step`. lost: whether the method has lost track of the position.
            points: [n, 2] contacts in base_link, m.
    """

    number: int
    pose: np.ndarray
    place: int
    seconds: float
    doubt: float
    lost: bool
    points: np.ndarray
    spread: np.ndarray


class Mapper(AbstractContextManager["Mapper"]):
    """Handle of the mapper process; a context manager. The process starts at once, to be ready early.

    Args:
        process: its main function; None: `run_mapper`.

    Attributes:
        mapped: results of all samples mapped so far, in order. drawing: the newest map as a whole, or None.
    """

    def __init__(self, process: Any = None) -> None:
        context = multiprocessing.get_context("spawn")
        self._line, theirs = context.Pipe()
        target = process or run_mapper
        self._process = context.Process(target=target, args=(theirs,), daemon=True, name="ratslam mapper")
        with withheld_signals():
            self._process.start()
        theirs.close()
        self.mapped: list[MappedSample] = []
        self.drawing: Drawing | None = None
        self._asked = self._stages = 0
        self._failed: InputError | str = ""  # a refusal of the job, or an error
        self._card: Scorecard | None = None
        self._offered: list[float] = []
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._sender = Thread(target=self._send, daemon=True, name="to mapper")
        self._sender.start()

    def prepare(self, message: MappingJob | Calibration | None) -> Callable[[], bool]:
        """Sends the job, for which the process compiles, and the next time the head's calibration (None
        without one): the process then makes its run directory and is ready for samples.

        Returns:
            at once, a function that says whether the process has done so; it raises `InputError` if the job
            was refused, or the process has ended.
        """
        self._outbox.put(message)
        self._asked += 1
        stages = self._asked

        def done() -> bool:
            self.receive()
            if isinstance(self._failed, InputError):
                raise self._failed
            if not self.alive:
                raise InputError("live", f"the mapper ended: {self.failure}", "")
            return self._stages >= stages

        return done

    def offer(self, sample: Sample, begins: bool = False) -> None:
        """Passes the next sample; returns at once.

        Args:
            begins: whether no odometry leads to it, so that it begins a piece of the map.
        """
        self._offered.append(time.monotonic())
        if begins:
            self._outbox.put(PIECE)
        self._outbox.put(sample)

    def warn(self, sentences: list[str]) -> None:
        """Passes warnings about the input to the run."""
        self._outbox.put(sentences)

    def behind(self) -> float:
        """Waiting time of the oldest sample that is not mapped yet, s."""
        self.receive()
        done = self.mapped[-1].number + 1 if self.mapped else 0
        return time.monotonic() - self._offered[done] if done < len(self._offered) else 0.0

    def receive(self) -> None:
        """Reads the messages of the process."""
        try:
            while self._line.poll():
                message = self._line.recv()
                if isinstance(message, MappedSample):
                    self.mapped.append(message)
                elif isinstance(message, Drawing):
                    self.drawing = message
                elif isinstance(message, Scorecard):
                    self._card = message
                elif message is True:
                    self._stages += 1
                else:
                    self._failed = message
        except (EOFError, OSError):
            self._failed = self._failed or "its connection broke"

    @property
    def alive(self) -> bool:
        """Whether the process runs and has reported no failure."""
        return self._process.is_alive() and not self._failed

    @property
    def failure(self) -> str:
        """Reason for the end of the mapper, as far as known."""
        return str(self._failed or f"it ended with code {self._process.exitcode}")

    def finish(self, interrupted: bool) -> Scorecard | None:
        """Waits until the samples that wait are mapped and scored; None if the process has ended, mapped
        nothing, or gives no result for `FINISH_TIMEOUT`.

        Args:
            interrupted: whether the session ended early.
        """
        self._outbox.put(interrupted)
        known, due = len(self.mapped), time.monotonic() + FINISH_TIMEOUT
        while self._card is None and self.alive and time.monotonic() < due:
            self._line.poll(0.05)
            self.receive()
            if len(self.mapped) > known:
                known, due = len(self.mapped), time.monotonic() + FINISH_TIMEOUT
        return self._card

    def _send(self) -> None:
        while True:
            message = self._outbox.get()
            try:
                self._line.send(message)
            except (OSError, ValueError):
                return
            if isinstance(message, bool):
                return

    def __exit__(self, *_: object) -> None:
        self._process.join(0.0 if self._card is None else 5.0)
        self._process.kill()  # at the end of this process SIGTERM would be sent, which it does not get
        self._process.join()
        self._outbox.put(True)
        self._line.close()


class PipeSource(ClosedSource):
    """The samples received through a pipe, as a source.

    Attributes:
        interrupted: whether the session ended early. received: arrival of the last sample, s. count: samples
            so far. begins: whether no odometry leads to the last sample. warnings: about the input.
    """

    name, digest, length = "live", "", None

    def __init__(self, like: SourceDescription, line: Connection) -> None:
        self.rate_hz, self.view_shape, self.whiskers = like.rate_hz, like.view_shape, like.whiskers
        self.info = like.info
        self.interrupted = True  # until the parent sends the flag
        self.received, self.count, self.begins = 0.0, 0, False
        self.warnings = list[str]()
        self._line = line

    def __iter__(self) -> Iterator[Sample]:
        piece = False
        while True:
            try:
                message = self._line.recv()
            except (EOFError, OSError):
                return  # the parent has ended
            if isinstance(message, bool):
                self.interrupted = message
                return
            if isinstance(message, list):
                self.warnings += message
                continue
            if message == PIECE:
                piece = True
                continue
            self.begins, piece = piece, False
            self.received, self.count = time.monotonic(), self.count + 1
            yield message


def run_mapper(line: Connection) -> None:
    """The main function of the mapper process."""
    step_back()  # compilation uses all cores
    try:
        _map(line)
    except InputError as error:
        _send(line, error)
    except EOFError:
        pass  # the parent has ended
    except Exception as error:
        _send(line, f"{type(error).__name__}: {error}")
        raise


def _map(line: Connection) -> None:
    from ratslam.live.goal_planner import felt_points
    from ratslam.runs.build_session import build_session
    from ratslam.runs.runner import check_finished_map, open_runner
    from ratslam.runs.settings.completion import complete
    from ratslam.service.viewer_link import open_viewer
    from robot.sources.in_memory import NO_ODOMETRY
    from robot.sources.odometry import correct_odometry
    from robot.touch_source import open_touch_source
    from tactile.base.types import observation

    job = line.recv()
    with PipeSource(job.source, line) as fed, open_viewer(job.view) as observers:
        config = complete(job.config, fed, job.extent_m)
        source = open_touch_source(fed, config.touch)  # for its shapes: no sample is read without calibration
        check_finished_map(config, source)
        session = build_session(config, source)
        like = observation(NO_ODOMETRY, view_shape=source.view_shape, whiskers=source.whiskers)
        session.rehearse(like, config.pose_cells.cell_size, config.session.seed)
        gc.collect()
        gc.freeze()  # what compiling has left need not be searched again: a full collection takes 0.1 s
        line.send(True)
        fed.info = fed.info.model_copy(update={"calibration": line.recv()})  # EOFError: the parent has ended
        read = correct_odometry(fed, config.recording.odometry) if config.recording else fed
        source = open_touch_source(read, config.touch)
        watchers = [*observers, _drawer(line)] if job.draws else observers
        opened = open_runner(
            config, source, job.directory, job.resume, session, watchers, warnings=fed.warnings
        )
        with opened as runner:
            # Sends the output of the process, including tracebacks, to a file: the terminal is the parent's.
            path = job.directory / LOG
            with path.open("ab") as file:
                os.dup2(file.fileno(), sys.stderr.fileno())
            if job.resume is not None:  # with as many rows as the map has
                session.warm(like)
            line.send(True)
            for sample in source:
                if fed.begins:
                    runner.session.begin_piece()
                (step,) = runner.process([sample])
                took = time.monotonic() - fed.received
                estimate, touch = step.estimate, config.touch
                points = felt_points(sample.reading, touch)
                result = MappedSample(
                    fed.count - 1, np.asarray(step.pose), int(estimate.place), took, step.doubt,
                    bool(estimate.lost), points, np.asarray(estimate.spread, float),
                )  # fmt: skip
                _send(line, result)
            if runner.session.steps:
                _send(line, runner.finish(fed.interrupted))


def _drawer(line: Connection) -> Callable[[Any], None]:
    """An observer of the run that sends the map as a whole whenever it is reported."""

    def observe(message: Any) -> None:
        report = message[1] if isinstance(message, tuple) and len(message) == 2 else None
        if report is None or report.path is None:
            return
        path = report.path[:: max(1, len(report.path) // MOST_DRAWN)]
        grid = report.grid
        drawing = Drawing(path) if grid is None else Drawing(path, grid.probability, grid.origin, grid.cell)
        _send(line, drawing)

    return observe


def _send(line: Connection, message: Any) -> None:
    with suppress(OSError):  # the parent has ended: results go to the disk only
        line.send(message)
