"""The main job: a recording or a simulated session through an engine into a run directory."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

from tqdm import tqdm

from evaluation.metrics.scorecard import Scorecard
from ratslam.config.run_config import RunConfig
from ratslam.core.session import CHUNK
from ratslam.pipeline.runner import Playing, playing
from robot.recordings.formats import open_recording
from robot.recordings.recorder import Recorder
from robot.simulation.create.session import CreateSimulation
from robot.simulation.head.session import HeadSimulation
from robot.sources.source import Sample, Source
from robot.touch_source import open_touch_source
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Whisk
from tactile.frontend import Frontend


def run(config: RunConfig, directory: Path, resume: Path | None = None) -> tuple[Scorecard, bool]:
    """Runs and scores.

    Args:
        resume: a checkpoint to continue from.

    Returns:
        the scorecard, and whether the run was interrupted (its outputs are then of the part done).

    Raises:
        InputError: the recording, the simulation, the checkpoint or the run directory cannot be used.
        OSError: the disk is full.
    """
    with open_source(config, _tell) as source:
        config = config.completed(source)
        source = open_touch_source(source, config.touch)
        with playing(config, source, directory, resume) as play:
            interrupted = replayed(play, source)
            return play.finish(interrupted), interrupted


def replayed(play: Playing, source: Source) -> bool:
    """Replays what is left of the source, with progress; whether the user interrupted."""
    samples = islice(iter(source), play.skipped, None)
    total = None if source.length is None else source.length - play.skipped
    bar = tqdm(total=total, unit="step", desc=source.name, file=sys.stderr, mininterval=0.5)
    last = "finishing this chunk and writing the results"
    with bar as progress, interrupts(last) as interrupted:
        while not interrupted() and (chunk := list(islice(samples, CHUNK - play.session.steps % CHUNK))):
            steps = play.feed(chunk)
            progress.update(len(chunk))
            progress.set_postfix(places=int(steps[-1].estimate.place) + 1, refresh=False)
        return interrupted()


def simulate(config: RunConfig, path: Path) -> tuple[int, bool]:
    """Writes the simulated session of a configuration to a recording: what each whisker felt, or its samples.

    Returns:
        how many whisks were written, and whether the user interrupted.

    Raises:
        InputError: there is nothing to simulate, it cannot be simulated, or the file exists.
    """
    if config.simulation is None and config.create_simulation is None:
        raise InputError("simulation", "missing", "what to simulate", "`simulation: {}` is a whole session")
    source = open_source(config, _tell)
    keep = _kept(config, source)
    recorder = recorder_of(path, source)
    bar = tqdm(source, unit="whisk", desc=source.name, file=sys.stderr, mininterval=0.5, total=source.length)
    with recorder, bar, interrupts("closing the file") as interrupted:
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
        info=source.info,
        chunk_s=CHUNK / (source.rate_hz or 1.0),
    )


def _kept(config: RunConfig, source: Source) -> Callable[[Sample], Sample]:
    """What of a simulated sample goes into a recording: what whiskers felt, unless raw samples are wanted."""
    if config.simulation is None or config.simulation.raw:
        return lambda sample: sample
    frontend = Frontend(config.touch, source.info.calibration)

    def felt(sample: Sample) -> Sample:
        if not isinstance(sample.reading, Cycle | Whisk):
            return sample
        return sample._replace(reading=frontend.features(sample.reading))

    return felt


def open_source(config: RunConfig, tell: Callable[[str], None] | None = None) -> Source:
    """The recording of a configuration, or its simulated session.

    Args:
        tell: called with one sentence on how much is simulated and why, or if only a part of a recording
            could be read.

    Raises:
        InputError: it cannot be read, or not be simulated.
    """
    if config.create_simulation is not None:
        return CreateSimulation(config.create_simulation)
    if config.simulation is not None:
        session = HeadSimulation(config.simulation, config.touch.head)
        if tell is not None:
            tell(f"simulating in the {session.tier.name} tier: {session.tier.why}")
        return session
    if config.recording is None:
        cure = "`python -m ratslam live` runs it; here its recording can be run"
        raise InputError("live", "a session on a robot", "a recording, or what to simulate", cure)
    return open_recording(config.recording, tell and (lambda sentence: tell(f"warning: {sentence}")))


@contextmanager
def interrupts(last: str) -> Iterator[Callable[[], bool]]:
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


def _tell(sentence: str) -> None:
    print(f"ratslam: {sentence}", file=sys.stderr)
