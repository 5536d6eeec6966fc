"""Statistics of a scene that settings follow from; short versions of its session; tiers of its simulation.

A tier is a fidelity of simulation; compared are its cost, and how its images differ from another tier's.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.metrics.metric import Finding, Quantity
from evaluation.studies.metrics import image_difference, quantities_of
from evaluation.studies.study import with_settings
from ratslam.runs.build_session import open_observations, open_source
from ratslam.runs.run import open_recorder
from ratslam.runs.settings.run_config import RunConfig
from robot.recordings.recording_config import RecordingConfig
from robot.simulation.head.simulated_session import HeadSimulation
from robot.sources.in_memory import InMemorySource, load_into_memory
from robot.sources.source import Source
from tactile.base.errors import InputError
from tactile.base.se2 import integrate

FEWEST_LAPS = 2  # laps of a shortened session: fewer give nothing to recognise


def compare_with_tier(config: RunConfig, log: InMemorySource, cost: float, tier: str) -> dict[str, Quantity]:
    """Cost of a simulated session, and the difference of its images from those of another tier.

    An `InputError` says that the session is not simulated, or has no images.

    Args:
        config: completed by the source. cost: time that simulation and images took, s.
    """
    if config.simulation is None or log.views is None:
        expected = "a session of whisker images to simulate"
        raise InputError("simulation", "missing", expected, "`simulation: {}` is a whole session")
    reference = _reference_views(with_tier(config, tier).model_dump_json())
    contact, height = image_difference(log.views, reference, config.touch.image.tallest)
    duration = float(log.time[-1] - log.time[0])
    findings = {"simulation_time": 1e6 * cost / duration, "contact_difference": contact}
    findings["height_difference"] = 1e3 * height
    return quantities_of({name: Finding(value) for name, value in findings.items()})


def with_tier(config: RunConfig, tier: str) -> RunConfig:
    """The configuration with another fidelity of simulation and without raw samples, if it simulates."""
    if config.simulation is None:
        return config
    return with_settings(config, {"simulation.fidelity": tier, "simulation.raw": False})


def shortened(config: RunConfig, seconds: float) -> RunConfig:
    """The configuration with fewer circuits, two at least, or less exploration; a path of cells stays."""
    cheapest = with_tier(config, "kinematic").simulation
    assert cheapest is not None
    path, length = cheapest.path, dict[str, Any]()
    if path.explore:
        length["simulation.path.explore"] = min(path.explore, seconds)
    elif path.circuits:
        lap = float(HeadSimulation(cheapest).time[-1]) / len(path.circuits)
        length["simulation.path.circuits"] = path.circuits[: max(FEWEST_LAPS, int(seconds / lap))]
    return with_settings(config, length)


@lru_cache(maxsize=1)
def _reference_views(config: str) -> np.ndarray:
    with open_observations(RunConfig.model_validate_json(config)) as (_, source):
        return load_into_memory(source).views


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
        moves = f"{self.usual:.2g} m a cycle (95 %: {self.most:.2g}), turns up to {self.turn:.2g} rad (95 %)"
        spans = f"{self.span[0]:.3g} x {self.span[1]:.3g} m"
        return f"{self.name}: {self.cycles} cycles{pace}; odometry spans {spans}, {moves}"


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
