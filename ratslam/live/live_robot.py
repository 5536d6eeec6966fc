"""The part of a live session that each robot provides, and what the robots' parts share."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from evaluation.metrics.run_metrics import DOUBTED
from ratslam.core.session import CHUNK
from ratslam.live.mapper_process import Mapper, MappingJob
from ratslam.runs.settings.run_config import RunConfig
from robot.drivers.outcome import SessionOutcome
from robot.live.recorder import LiveRecorder
from robot.recordings.recording_config import RecordingConfig
from tactile.calibration import Calibration

RECORDING = "session.mcap"
"""The recording in the run directory."""
START_TIMEOUT = 300.0
"""Time limit of the mapper's start, with compilation, s."""


class LiveRig(AbstractContextManager[Any], Protocol):
    """The devices of a session; the context manager leaves the robot at rest."""

    recorder: LiveRecorder | None

    def begin(self) -> None:
        """Sets time 0 of the session to now."""
        ...

    def rest(self) -> bool:
        """Stops the robot; returns whether it rests."""
        ...

    def record_event(self, name: str, text: str) -> None:
        """Records an event."""
        ...

    def wait_until(self, done: Callable[[], bool], longest: float, late: SessionOutcome, what: str) -> None:
        """Polls until a condition is true."""
        ...


class LiveRobot(Protocol):
    """The part of a session that depends on the robot."""

    @property
    def rig(self) -> LiveRig:
        """Its devices."""
        ...

    @property
    def job(self) -> MappingJob:
        """The job of the mapper."""
        ...

    @property
    def unit(self) -> str:
        """Name of a reading."""
        ...

    @property
    def total(self) -> int | None:
        """Expected number of readings, None if unknown."""
        ...

    @property
    def count(self) -> int:
        """Readings passed on so far."""
        ...

    @property
    def end(self) -> SessionOutcome:
        """The outcome of a session that ends as planned."""
        ...

    def prepare(self, mapper: Mapper, log: Callable[[str], None]) -> Calibration | None:
        """Finds and tests the devices and waits for the mapper; returns the head's calibration, if any."""
        ...

    def run(self, mapper: Mapper, tell: Callable[[str], None]) -> None:
        """Passes readings to recorder and mapper until the planned end; tells the state after each."""
        ...

    def report(self) -> dict[str, Any]:
        """What it adds to the report of the session, as JSON values."""
        ...


def mapped_config(config: RunConfig, directory: Path, rows: int) -> RunConfig:
    """The configuration of the mapper, which `run` repeats from the recording.

    Args:
        rows: to reserve where the configuration reserves none, so that nothing compiles in the session.
    """
    session = config.session
    if not session.reserve:
        session = session.model_copy(update={"reserve": rows + CHUNK})
    recording = RecordingConfig(file=directory.resolve() / RECORDING)
    return config.model_copy(update={"live": None, "recording": recording, "session": session})


def compile_mapper(rig: LiveRig, mapper: Mapper, job: MappingJob, log: Callable[[str], None]) -> None:
    """Waits until the mapper has compiled for a job."""
    log("mapper: compiling")
    mapper.compile(job)
    rig.wait_until(mapper.compiled, START_TIMEOUT, SessionOutcome.MAPPER_GONE, "compiling")


def begin_mapping(rig: LiveRig, mapper: Mapper, calibration: Calibration | None) -> None:
    """Waits until the mapper has made its run directory and is ready for samples."""
    mapper.begin(calibration)
    rig.wait_until(mapper.ready, START_TIMEOUT, SessionOutcome.MAPPER_GONE, "the mapper's start")


def mapper_status(mapper: Mapper) -> str:
    """The newest result of the mapper as text: empty, or with a comma at its end."""
    result = mapper.mapped[-1] if mapper.mapped else None
    place = "" if result is None or result.place < 0 else f", place {result.place}"
    place += "" if result is None or not result.doubt > DOUBTED else ", map_doubted"
    return "" if result is None else f"map {1e3 * result.seconds:.0f} ms{place}, "


def quantiles(values: list[float]) -> dict[str, float]:
    """Median, 99 % quantile and maximum of the finite values; empty without any."""
    known = np.array(values)[np.isfinite(values)]
    if not len(known):
        return {}
    return {name: float(np.quantile(known, q)) for name, q in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))}
