"""Correction of an odometry whose systematic errors are known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from pydantic import PositiveFloat

from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of
from robot.sources.source import Sample, Source
from tactile.base.config import Settings
from tactile.base.se2 import correct_heading
from tactile.base.types import Observation, Odometry


class OdometryCorrection(Settings):
    """Systematic errors of an odometry, taken out of it; `python -m ratslam fit` finds them."""

    length_scale: PositiveFloat = 1.0
    """True distance for each metre of the odometry."""
    turn_scale: PositiveFloat = 1.0
    """True turn for each radian of the odometry."""
    heading_bias: float = 0.0
    """Turn to add for each metre of the odometry, rad/m, counter-clockwise."""


UNCORRECTED = OdometryCorrection()


def correct_motions(correction: OdometryCorrection, motion: np.ndarray) -> np.ndarray:
    """Motions [..., 3] (m, m, rad) of an odometry without its systematic errors."""
    motion = np.asarray(motion, float)
    length = np.hypot(motion[..., 0], motion[..., 1])
    scaled = motion * np.array([correction.length_scale, correction.length_scale, 1.0])
    return correct_heading(scaled, length, correction.heading_bias, correction.turn_scale - 1)


def correct_observations(
    correction: OdometryCorrection, observations: Sequence[Observation]
) -> list[Observation]:
    """Observations with the odometry corrected."""
    motions = np.array([observation.odometry[:3] for observation in observations]).reshape(-1, 3)
    return [
        observation._replace(odometry=Odometry(dx, dy, dtheta, observation.odometry.dt))
        for observation, (dx, dy, dtheta) in zip(
            observations, correct_motions(correction, motions), strict=True
        )
    ]


def correct_odometry(source: Source, correction: OdometryCorrection) -> Source:
    """The source with corrected odometry; its digest tells the correction too."""
    if correction == UNCORRECTED:
        return source
    digest = digest_of([source.digest.encode(), correction.model_dump_json().encode()])
    if isinstance(source, InMemorySource):
        motion = np.column_stack([correct_motions(correction, source.motion[:, :3]), source.motion[:, 3]])
        return replace(source, motion=motion, digest=digest)
    return _CorrectedSource(source, correction, digest)


class _CorrectedSource:
    """A source that corrects each reading as it passes."""

    def __init__(self, source: Source, correction: OdometryCorrection, digest: str) -> None:
        self._source, self._correction = source, correction
        self.name, self.rate_hz, self.view_shape = source.name, source.rate_hz, source.view_shape
        self.whiskers, self.length, self.info = source.whiskers, source.length, source.info
        self.digest = digest

    def __enter__(self) -> _CorrectedSource:
        self._source.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._source.__exit__(*error)  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[Sample]:
        for sample in self._source:
            *motion, dt = sample.reading.odometry
            dx, dy, dtheta = correct_motions(self._correction, np.array(motion, float))
            moved = Odometry(dx, dy, dtheta, dt)
            yield sample._replace(reading=sample.reading._replace(odometry=moved))
