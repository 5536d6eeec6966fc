"""Runs a configuration: maps its source into a run directory, or records its simulation."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from types import FrameType

import numpy as np
from tqdm import tqdm

from evaluation.metrics.scorecard import Scorecard
from ratslam.core.session import CHUNK
from ratslam.runs.build_session import open_observations, open_source
from ratslam.runs.runner import Observer, Runner, open_runner
from ratslam.runs.settings.run_config import RunConfig
from robot.drivers.processes import postpone_interrupt
from robot.recordings.mcap_writer import Recorder
from robot.sources.source import Source
from tactile.base.errors import InputError, printable, tell
from tactile.base.types import Cycle, Whisk
from tactile.frontend import Frontend

LAST_TASK = "finishing this chunk and writing the results"


def run(
    config: RunConfig, directory: Path, resume: Path | None = None, observers: Sequence[Observer] = ()
) -> tuple[Scorecard, bool]:
    """Maps the source of a configuration and scores the result.

    Args:
        config: with absolute paths. directory: the new run directory.
        resume: map to continue from, a run directory or a file. observers: are told of the progress.

    Returns:
        the scorecard, and whether Ctrl-C ended the run early; the results are then those up to that step.

    Raises:
        InputError: the source, the checkpoint or the run directory cannot be used.
        OSError: the disk is full.
    """
    warnings: list[str] = []
    with (
        open_observations(config, tell, warnings) as (completed, source),
        open_runner(completed, source, directory, resume, observers=observers, warnings=warnings) as runner,
        catch_interrupt(LAST_TASK),
    ):
        interrupted = process_source(runner, source)
        return runner.finish(interrupted), interrupted


def process_source(runner: Runner, source: Source) -> bool:
    """Processes all samples that the runner has not processed yet, with a progress bar.

    Returns:
        whether Ctrl-C ended it early.

    Raises:
        KeyboardInterrupt: Ctrl-C ended it before the first sample.
    """
    samples = islice(iter(source), runner.skipped, None)
    total = None if source.length is None else source.length - runner.skipped
    with _bar(source, "step", total) as bar, catch_interrupt(LAST_TASK) as interrupted:
        begun, number = False, runner.skipped
        pieces = sorted(getattr(source, "begins", ()))
        while not interrupted():
            if number in pieces:
                runner.session.begin_piece()
            until = next((first for first in pieces if first > number), np.inf)
            longest = min(CHUNK - runner.session.steps % CHUNK, until - number)
            if not (chunk := list(islice(samples, int(longest)))):
                break
            number += len(chunk)
            begun, steps = True, runner.process(chunk)
            bar.update(len(chunk))
            bar.set_postfix(places=int(steps[-1].estimate.place) + 1, refresh=False)
        if interrupted() and not begun:
            raise KeyboardInterrupt
        return interrupted()


def simulate(config: RunConfig, path: Path) -> tuple[int, bool]:
    """Records the simulated session of a configuration: contact features, or raw samples if it asks for them.

    Args:
        config: with absolute paths. path: the new file.

    Returns:
        the number of steps written, and whether Ctrl-C ended it early.

    Raises:
        InputError: the configuration has no simulation, it cannot be simulated, or the file exists.
    """
    if config.simulation is config.create_simulation is config.rat_simulation is None:
        raise InputError("simulation", "missing", "a simulation", "`simulation: {}` is a complete session")
    source = open_source(config, tell)
    raw = config.simulation is None or config.simulation.raw
    frontend = None if raw else Frontend(config.touch, source.info.calibration)
    recorder = open_recorder(path, source)
    bar = _bar(source, "whisk", source.length)
    with recorder, bar, catch_interrupt("closing the file") as interrupted:
        for sample in source:
            if frontend is not None and isinstance(sample.reading, Cycle | Whisk):
                sample = sample._replace(reading=frontend.features(sample.reading))
            recorder.write(sample)
            bar.update()
            if interrupted():
                break
        return recorder.count, interrupted()


def _bar(source: Source, unit: str, total: int | None) -> tqdm:
    return tqdm(total=total, unit=unit, desc=printable(source.name), file=sys.stderr, mininterval=0.5)


def open_recorder(path: Path, source: Source) -> Recorder:
    """A recorder for the samples of a source, which writes one chunk of a session at a time.

    Raises:
        InputError: the file exists or cannot be created.
    """
    return Recorder(path, source, chunk_s=CHUNK / (source.rate_hz or 1.0))


class _Interrupts:
    """Handler of Ctrl-C: the first is noted, the second raises `KeyboardInterrupt`, and further ones are
    ignored, because what the second has left is being closed.

    Args:
        last_task: printed at the first: the work left before the program ends.
    """

    def __init__(self, last_task: str) -> None:
        self._last_task, self._count = last_task, 0

    def pressed(self) -> bool:
        return self._count > 0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self._count == 1 and postpone_interrupt(frame):
            return
        self._count += 1
        if self._count == 1:
            print(f"\nratslam: interrupted; {self._last_task} ...", file=sys.stderr)
        elif self._count == 2:
            raise KeyboardInterrupt


@contextmanager
def catch_interrupt(last_task: str) -> Iterator[Callable[[], bool]]:
    """Yields a function that returns whether Ctrl-C was pressed; a second Ctrl-C raises `KeyboardInterrupt`.

    Within another such block it is that block's. In a thread other than the main one Ctrl-C is not caught.

    Args:
        last_task: printed at the first Ctrl-C: the work left before the program ends.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.getsignal(signal.SIGINT)
    if isinstance(before, _Interrupts):
        yield before.pressed
        return
    handler = _Interrupts(last_task)
    signal.signal(signal.SIGINT, handler)
    try:
        yield handler.pressed
    finally:
        signal.signal(signal.SIGINT, before)
