"""The engine in a process of its own: samples go in as they come, steps come back when they are done.

The process that moves the robot never waits for it, and a fault in one does not end the other: without its
parent, the mapper ends the run directory with what it has.
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np

from evaluation.metrics.scorecard import Scorecard
from ratslam.config.run_config import RunConfig
from robot.drivers.process_priority import BACKGROUND, set_niceness
from robot.sources.source import Sample
from robot.sources.source_info import SourceInfo
from tactile.base.errors import InputError

LOG = "mapper.log"
"""In the run directory: what the mapper's process had to say."""
FINISH_TIMEOUT = 120.0
"""How long it may take to score and draw, s."""


class MappingJob(NamedTuple):
    """What is to be mapped.

    Attributes:
        config: with `recording` being what the session is recorded to. info: as in the recording.
        directory: the new run directory. view_shape, whiskers, rate_hz: of the samples.
        extent_m: largest distance from the start along x or y on the planned path, m.
    """

    config: RunConfig
    info: SourceInfo
    directory: Path
    view_shape: tuple[int, int, int]
    whiskers: int
    rate_hz: float
    extent_m: float


class MappedSample(NamedTuple):
    """What a sample led to.

    Attributes:
        number: of the sample. pose: [3] as estimated then, in the map. place: -1 without one. action: by
            name. seconds: that it took.
    """

    number: int
    pose: np.ndarray
    place: int
    action: str
    seconds: float


class Mapper:
    """The mapper's process from outside; a context manager. It starts at once, to be ready when it is needed.

    Attributes:
        told: of every sample that was mapped, in order.
    """

    def __init__(self, process: Any = None) -> None:
        context = multiprocessing.get_context("spawn")
        self._line, theirs = context.Pipe()
        target = process or run_mapper
        self._process = context.Process(target=target, args=(theirs,), daemon=True, name="ratslam mapper")
        self._process.start()
        theirs.close()
        self.mapped: list[MappedSample] = []
        self._ready, self._failed = False, ""
        self._refusal: InputError | None = None
        self._card: Scorecard | None = None
        self._offered: list[float] = []
        self._outbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._sender = Thread(target=self._send, daemon=True, name="to mapper")
        self._sender.start()

    def begin(self, order: MappingJob) -> None:
        """Has it make its directory and compile; returns at once, `ready` tells when it is done."""
        self._outbox.put(order)

    def ready(self) -> bool:
        """Whether samples may come.

        Raises:
            InputError: what it was ordered cannot be done, or it is no more.
        """
        self.receive()
        if self._refusal is not None:
            raise self._refusal
        if not self.alive:
            raise InputError("live", f"the mapper ended: {self.failure}", "")
        return self._ready

    def offer(self, sample: Sample) -> None:
        """The next sample; returns at once."""
        self._offered.append(time.monotonic())
        self._outbox.put(sample)

    def behind(self) -> float:
        """For how long the oldest sample that is not mapped yet has waited, s."""
        self.receive()
        return (
            time.monotonic() - self._offered[len(self.mapped)]
            if len(self.mapped) < len(self._offered)
            else 0.0
        )

    def receive(self) -> None:
        """Takes in what it has told."""
        try:
            while self._line.poll():
                self._take(self._line.recv())
        except (EOFError, OSError):
            self._failed = self._failed or "its line broke"

    @property
    def alive(self) -> bool:
        """Whether it can still map."""
        return self._process.is_alive() and not self._failed and self._refusal is None

    @property
    def failure(self) -> str:
        """Why it cannot, as far as is known."""
        return self._failed or str(self._refusal or f"it ended with code {self._process.exitcode}")

    def finish(self, interrupted: bool) -> Scorecard | None:
        """The score of what was mapped; None if it is no more, or mapped nothing.

        Args:
            interrupted: whether there was more to come.
        """
        self._outbox.put(interrupted)
        due = time.monotonic() + FINISH_TIMEOUT
        while self._card is None and self.alive and time.monotonic() < due:
            self._line.poll(0.05)
            self.receive()
        return self._card

    def _take(self, word: Any) -> None:
        if isinstance(word, MappedSample):
            self.mapped.append(word)
        elif isinstance(word, Scorecard):
            self._card = word
        elif isinstance(word, InputError):
            self._refusal = word
        elif word is True:
            self._ready = True
        else:
            self._failed = str(word)

    def _send(self) -> None:
        while True:
            word = self._outbox.get()
            try:
                self._line.send(word)
            except (OSError, ValueError):
                return
            if isinstance(word, bool):
                return

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._card is None and self._process.is_alive():
            self._process.kill()
        self._process.join(5.0)
        self._outbox.put(True)
        self._line.close()


class PipeSource:
    """Samples as they come down a line, as a source.

    Attributes:
        interrupted: whether there was more to come, when it ends. received: when the last sample came, s.
    """

    name, digest, length = "live", "", None

    def __init__(self, order: MappingJob, line: Connection) -> None:
        self.rate_hz, self.view_shape, self.whiskers = order.rate_hz, order.view_shape, order.whiskers
        self.info = order.info
        self.interrupted = True  # unless the parent says otherwise
        self.received = 0.0
        self._line = line

    def __iter__(self) -> Iterator[Sample]:
        while True:
            try:
                word = self._line.recv()
            except (EOFError, OSError):
                return  # nobody is there any more
            if isinstance(word, bool):
                self.interrupted = word
                return
            self.received = time.monotonic()
            yield word

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        return None


def run_mapper(line: Connection) -> None:
    """What the mapper's process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to hear
    set_niceness(BACKGROUND)  # compiling takes every core there is
    try:
        _map(line)
    except InputError as error:
        _send(line, error)
    except EOFError:
        pass  # nobody wants it any more
    except Exception as error:
        _send(line, f"{type(error).__name__}: {error}")
        raise


def _map(line: Connection) -> None:
    from ratslam.config.completion import complete
    from ratslam.core.types import Action
    from ratslam.pipeline.runner import open_runner
    from robot.touch_source import open_touch_source
    from tactile.base.types import Odometry, observation

    order = line.recv()
    with PipeSource(order, line) as fed:
        config = complete(order.config, fed, order.extent_m)
        source = open_touch_source(fed, config.touch)
        with open_runner(config, source, order.directory) as runner:
            _redirect_stderr(order.directory / LOG)
            blank = observation(
                Odometry(0.0, 0.0, 0.0, 0.0), view_shape=source.view_shape, whiskers=source.whiskers
            )
            runner.session.warm(blank)
            line.send(True)
            for number, sample in enumerate(source):
                (step,) = runner.process([sample])
                action = Action(int(step.estimate.action)).name.lower()
                took = time.monotonic() - fed.received
                _send(
                    line, MappedSample(number, np.asarray(step.pose), int(step.estimate.place), action, took)
                )
            if runner.session.steps:
                _send(line, runner.finish(fed.interrupted))


def _send(line: Connection, word: Any) -> None:
    with suppress(OSError):  # nobody listens: the results are for the disk
        line.send(word)


def _redirect_stderr(path: Path) -> None:
    """What the process prints, tracebacks included, goes to a file: the terminal is the parent's."""
    with path.open("ab") as file:
        os.dup2(file.fileno(), sys.stderr.fileno())
