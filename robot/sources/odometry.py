"""Body-frame motion from logged velocities, motions or poses, and the correction of systematic errors.

A motion is a row (dx m, dy m, dtheta rad, dt s): the pose after a step in the frame of the pose before it.
The first row only sets the clock: its motion and duration are zero.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from pydantic import PositiveFloat

from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of
from robot.sources.source import Sample, Source
from tactile.base.se2 import between, correct_heading, integrate
from tactile.base.settings import Settings
from tactile.base.types import Observation, Odometry

TURN_THEN_MOVE = 1.0  # share of the turn before the robot moves: all of it, as in OpenRatSLAM
MIDPOINT = 0.5  # half of it: second order, exact to O(turn^2) for a constant twist


def from_velocities(
    time: np.ndarray,
    forward: np.ndarray,
    left: np.ndarray | float,
    turn: np.ndarray,
    heading: float = MIDPOINT,
) -> np.ndarray:
    """Motions [N, 4] for velocities that hold from row i - 1 to row i.

    Args:
        time: [N] s. forward, left: [N] m/s in the body frame. turn: [N] rad/s, counter-clockwise.
        heading: share of the step's turn made before the robot moves, `MIDPOINT` or
            `TURN_THEN_MOVE`.
    """
    dt = np.diff(time, prepend=time[:1])
    dtheta = turn * dt
    x, y = _turned(forward, left, heading * dtheta)
    return np.stack([x * dt, y * dt, dtheta, dt], axis=-1)


def from_motions(
    time: np.ndarray, forward: np.ndarray, left: np.ndarray | float, turn: np.ndarray
) -> np.ndarray:
    """Motions [N, 4] for distances since the previous row, along the heading half-way through the turn.

    Args:
        time: [N] s. forward, left: [N] m in the body frame. turn: [N] rad, counter-clockwise.
    """
    dt = np.diff(time, prepend=time[:1])
    motion = np.stack([*_turned(forward, left, MIDPOINT * turn), turn, dt], axis=-1)
    motion[:1] = 0.0
    return motion


def _turned(
    forward: np.ndarray, left: np.ndarray | float, angle: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The vectors (forward, left) turned by angles, rad."""
    c, s = np.cos(angle), np.sin(angle)
    return c * forward - s * left, s * forward + c * left


def from_poses(time: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Motions [N, 4] between successive poses [N, 3] of a world frame, including sideways motion."""
    steps = between(poses[:-1], poses[1:])
    return np.column_stack([np.vstack([np.zeros((1, 3)), steps]), np.diff(time, prepend=time[:1])])


def odometry_extent(source: Source) -> float:
    """Largest distance from the start along either axis of the start frame, from odometry, m."""
    moves = np.array([sample.reading.odometry[:3] for sample in source], float).reshape(-1, 3)
    path = integrate(np.where(np.isfinite(moves), moves, 0.0), np.zeros(3))
    return float(np.abs(path[:, :2]).max(initial=0.0))


class OdometryCorrection(Settings):
    """Systematic errors of an odometry, taken out of it; `python -m ratslam fit` finds them."""

    length_scale: PositiveFloat = 1.0
    """True distance for each metre of the odometry."""
    turn_scale: PositiveFloat = 1.0
    """True turn for each radian of the odometry."""
    heading_bias: float = 0.0
    """Turn to add for each metre of the odometry, rad/m, counter-clockwise."""
    largest_step: PositiveFloat | None = None
    """Longest step that can be true, m: a longer one (a wild pose, a reset, a velocity over a gap) is
    replaced by the step before it. Null: none is."""
    largest_turn: PositiveFloat | None = None
    """Largest turn in a step that can be true, rad, likewise."""


UNCORRECTED = OdometryCorrection()


def replace_steps(
    correction: OdometryCorrection, motion: np.ndarray, before: np.ndarray | None = None
) -> np.ndarray:
    """Motions [N, 3] (m, m, rad), those beyond the largest step and turn replaced by the last one within.

    Args:
        before: [3] the motion before the first; None: no motion.
    """
    if correction.largest_step is None and correction.largest_turn is None:
        return motion
    most = [np.inf if each is None else each for each in (correction.largest_step, correction.largest_turn)]
    good = (np.hypot(motion[:, 0], motion[:, 1]) <= most[0]) & (np.abs(motion[:, 2]) <= most[1])
    last = np.maximum.accumulate(np.where(good, np.arange(1, len(motion) + 1), 0))
    return np.concatenate([np.zeros((1, 3)) if before is None else before[None], motion])[last]


def correct_motions(correction: OdometryCorrection, motion: np.ndarray) -> np.ndarray:
    """Motions [..., 3] (m, m, rad) of an odometry without its systematic errors; none is replaced."""
    motion = np.asarray(motion, float)
    length = np.hypot(motion[..., 0], motion[..., 1])
    scaled = motion * np.array([correction.length_scale, correction.length_scale, 1.0])
    return correct_heading(scaled, length, correction.heading_bias, correction.turn_scale - 1)


def correct_observations(
    correction: OdometryCorrection, observations: Sequence[Observation]
) -> list[Observation]:
    """Observations with the odometry corrected."""
    motions = np.array([observation.odometry[:3] for observation in observations]).reshape(-1, 3)
    corrected = correct_motions(correction, replace_steps(correction, motions))
    pairs = zip(observations, corrected, strict=True)
    return [each._replace(odometry=Odometry._make([*motion, each.odometry.dt])) for each, motion in pairs]


def correct_odometry(source: Source, correction: OdometryCorrection) -> Source:
    """The source with corrected odometry; its digest tells the correction too."""
    if correction == UNCORRECTED:
        return source
    digest = digest_of([source.digest.encode(), correction.model_dump_json(exclude_none=True).encode()])
    if isinstance(source, InMemorySource):
        moved, motion = source.moved, source.motion.copy()
        motion[moved, :3] = correct_motions(correction, replace_steps(correction, motion[moved, :3]))
        return replace(source, motion=motion, digest=digest)
    return _CorrectedSource(source, correction, digest)


class _CorrectedSource:
    """A source that corrects each reading as it passes."""

    def __init__(self, source: Source, correction: OdometryCorrection, digest: str) -> None:
        self._source, self._correction = source, correction
        self.name, self.rate_hz, self.view_shape = source.name, source.rate_hz, source.view_shape
        self.whiskers, self.length, self.info = source.whiskers, source.length, source.info
        self.digest = digest
        self.begins: frozenset[int] = getattr(source, "begins", frozenset())

    def __enter__(self) -> _CorrectedSource:
        self._source.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._source.__exit__(*error)  # type: ignore[arg-type]

    def __iter__(self) -> Iterator[Sample]:
        before = np.zeros(3)
        for sample in self._source:
            *motion, dt = sample.reading.odometry
            before = replace_steps(self._correction, np.array([motion], float), before)[0]
            dx, dy, dtheta = correct_motions(self._correction, before)
            moved = Odometry(dx, dy, dtheta, dt)
            yield sample._replace(reading=sample.reading._replace(odometry=moved))
