"""The part of a live session that each robot provides, and what the robots' parts share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from evaluation.metrics.run_metrics import DOUBTED
from ratslam.core.session import CHUNK
from ratslam.live.mapper_process import Mapper, MappingJob
from ratslam.runs.settings.run_config import RunConfig
from robot.drivers.outcome import SessionOutcome
from robot.live.create_rig import CreateRig
from robot.live.live_rig import ArmRig
from robot.live.polling import HeadRig
from robot.live.selftest import find_devices, start_and_check
from robot.live.topics_rig import TopicsRig
from robot.recordings.recording_config import RecordingConfig
from robot.sources.odometry import UNCORRECTED
from tactile.calibration import Calibration

RECORDING = "session.mcap"
"""The recording in the run directory."""


class LiveRobot:
    """The part of a session that depends on the robot.

    Attributes:
        rig: its devices. job: of the mapper, known once the devices are found. unit: name of a reading.
            total: expected number of readings, None if unknown. count: readings passed on so far.
            view: target of a live view, or None. resume: map to continue, or None.
    """

    unit: str
    rig: ArmRig | CreateRig | TopicsRig
    job: MappingJob
    view: str | None = None
    resume: Path | None = None
    total: int | None
    count = 0

    @property
    def end(self) -> SessionOutcome:
        """The outcome of a session that ends as planned."""
        return SessionOutcome.COMPLETE

    def find(self) -> Iterator[str]:
        """Finds the devices; see `robot.live.selftest.find_devices`."""
        assert not isinstance(self.rig, TopicsRig)
        return find_devices(self.rig)

    def check(self) -> Iterator[str]:
        """Starts and checks the devices; see `robot.live.selftest.start_and_check`."""
        assert not isinstance(self.rig, TopicsRig)
        return start_and_check(self.rig)

    def calibrate(self, log: Callable[[str], None]) -> Calibration | None:
        """The head's calibration, if any; the devices are tested."""
        del log
        return None

    def lower(self, calibration: Calibration | None) -> None:
        """Brings the robot to the place where the session begins; the mapper is ready."""

    def run(self, mapper: Mapper, tell: Callable[[str], None]) -> None:
        """Passes readings to recorder and mapper until the planned end; tells the state after each."""
        raise NotImplementedError

    def report(self) -> dict[str, Any]:
        """What it adds to the report of the session, as JSON values."""
        assert isinstance(self.rig, HeadRig)
        head = self.rig.head
        return {"head": head.decoder.counts._asdict() | {"stalls": head.stalls}}


def mapped_config(config: RunConfig, directory: Path, rows: int) -> RunConfig:
    """The configuration of the mapper, which `run` repeats from the recording.

    Args:
        rows: to reserve where the configuration reserves none, so that nothing compiles in the session.
    """
    session = config.session
    if not session.reserve:
        session = session.model_copy(update={"reserve": rows + CHUNK})
    odometry = UNCORRECTED if config.recording is None else config.recording.odometry
    recording = RecordingConfig(file=directory.resolve() / RECORDING, odometry=odometry)
    return config.model_copy(update={"live": None, "recording": recording, "session": session})


def mapper_status(mapper: Mapper) -> str:
    """The newest result of the mapper as text: empty, or with a comma at its end."""
    if not mapper.mapped:
        return ""
    result = mapper.mapped[-1]
    place = f", place {result.place}" if result.place >= 0 else ""
    doubted = ", map_doubted" if result.doubt > DOUBTED else ""
    return f"map {1e3 * result.seconds:.0f} ms{place}{doubted}, "


def quantiles(values: list[float]) -> dict[str, float]:
    """Median, 99 % quantile and maximum of the finite values; empty without any."""
    known = np.array(values)[np.isfinite(values)]
    if not len(known):
        return {}
    return {name: float(np.quantile(known, q)) for name, q in (("p50", 0.5), ("p99", 0.99), ("max", 1.0))}
