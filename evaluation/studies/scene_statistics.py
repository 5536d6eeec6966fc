"""Statistics of a scene that settings follow from, and a short version of its session."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.studies.study import with_settings
from evaluation.studies.tiers import shortened
from ratslam.runs.open_source import open_source
from ratslam.runs.run import open_recorder
from ratslam.runs.settings.run_config import RunConfig
from robot.recordings.recording_config import RecordingConfig
from robot.sources.source import Source
from tactile.base.errors import InputError
from tactile.base.se2 import integrate

STANDING = 0.1  # share of the longest distance of a cycle below which a cycle counts as standing
USUAL, MOST = 0.5, 0.95  # quantiles of a usual cycle and of all but a few


class Scene(NamedTuple):
    """Statistics of a session's odometry."""

    name: str  # of the source
    cycles: int  # number of cycles
    rate: float  # of the cycles, Hz; 0 if unknown
    span: tuple[float, float]  # m, what the path covers along x and y
    usual: float  # m, median of the distance driven in a cycle, where one is driven
    most: float  # m, its 95 % quantile
    turn: float  # rad, 95 % quantile of the angle turned by in a cycle

    def describe(self) -> str:
        """The statistics as a sentence."""
        pace = f" at {self.rate:.3g} Hz, {self.usual * self.rate:.3g} m/s" if self.rate else ""
        return (
            f"{self.name}: {self.cycles} cycles{pace}; odometry spans {self.span[0]:.3g} x "
            f"{self.span[1]:.3g} m, {self.usual:.2g} m a cycle (95 %: {self.most:.2g}), turns up to "
            f"{self.turn:.2g} rad (95 %)"
        )


def scene_of(source: Source) -> Scene:
    """The statistics of a source; raises an `InputError` if its odometry has no finite motion."""
    moves = np.array([sample.reading.odometry[:3] for sample in source], float).reshape(-1, 3)
    moves = moves[np.isfinite(moves).all(axis=1)]
    if not len(moves):
        raise InputError(source.name, "no odometry", "a session with motion")
    path = integrate(moves)[:, :2]
    distance, turn = np.hypot(moves[:, 0], moves[:, 1]), np.abs(moves[:, 2])
    driving = distance[distance > STANDING * distance.max()]
    if not len(driving):
        raise InputError(source.name, "a robot that never moves", "a session with motion")
    width, height = np.ptp(path, axis=0)
    usual, most = (float(np.quantile(driving, share)) for share in (USUAL, MOST))
    span, most_turn = (float(width), float(height)), float(np.quantile(turn, MOST))
    return Scene(source.name, len(moves), source.rate_hz, span, usual, most, most_turn)


def short_session(config: RunConfig, cycles: int, folder: Path) -> RunConfig:
    """The configuration with about the given number of cycles: whole circuits, two at least; of a recording
    its beginning, which is copied to the folder. An `InputError` says that it cannot be read."""
    if (create := config.create_simulation) is not None:
        reports = min(create.reports or cycles, cycles)
        return with_settings(config, {"create_simulation.reports": reports})
    if config.simulation is not None:
        return shortened(config, cycles / config.simulation.whisking.rate)
    path = folder / "beginning.mcap"
    with open_source(config) as source, open_recorder(path, source) as recorder:
        for sample in islice(source, cycles):
            recorder.write(sample)
    return with_settings(config, {"recording": RecordingConfig(file=path)})
