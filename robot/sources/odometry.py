"""Body-frame motion from logged velocities, motions or poses, and simulated odometry errors.

A motion is a row (dx m, dy m, dtheta rad, dt s): the pose after a step in the frame of the pose before it.
The first row only sets the clock: its motion and duration are zero.

Correction of an odometry whose systematic errors are known, and of steps that cannot be true.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of
from robot.sources.source import Sample, Source
from tactile.base.se2 import between, correct_heading, integrate, wrap
from tactile.base.settings import Settings
from tactile.base.types import Observation, Odometry

TURN_THEN_MOVE = 1.0  # share of the turn before the robot moves: all of it, as in OpenRatSLAM
MIDPOINT = 0.5  # half of it: second order, exact to O(turn^2) for a constant twist
DRIVING_SPEED = 1e-3
"""Speed above which a robot counts as driving, m/s."""
TURNING_RATE = 0.06
"""Turn rate above which a robot counts as turning, rad/s."""


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
    motion = np.stack(
        [*_turned(forward, left, MIDPOINT * turn), turn, np.diff(time, prepend=time[:1])], axis=-1
    )
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


class OdometryConfig(Settings):
    """Odometry errors of the UR-10 (Salman & Pearson 2016, III-C, which leaves their structure open)."""

    noise: Literal["white", "gated", "telescoping", "none"] = "gated"
    """`white`: in every sample; `gated`: only in the part (forward, turn) that moves; `telescoping`: of the
    poses, so that errors do not accumulate, as with time stamp jitter."""
    rate: PositiveFloat = 1.0
    """Odometry samples per second."""
    length: NonNegativeFloat = 8.2e-3
    """Standard deviation of the forward motion in a sample, m."""
    heading: NonNegativeFloat = 0.103
    """Standard deviation of the turn in a sample, rad."""
    length_bias: NonNegativeFloat = 0.0
    """Standard deviation of one scale error of all lengths in a session, as a fraction."""
    heading_bias: NonNegativeFloat = 0.0
    """Standard deviation of one heading error per distance in a session, rad/m."""


def simulate_odometry(
    config: OdometryConfig,
    time: np.ndarray,
    pose: np.ndarray,
    random: np.random.Generator,
    kidnapped: np.ndarray | None = None,
) -> np.ndarray:
    """[N, 4] odometry (dx m, dy m, dtheta rad, dt s) since the previous row, with errors.

    Args:
        time: [N] s. pose: [N, 3] true poses, headings not wrapped. kidnapped: [N] bool, the robot was moved
            by hand since the previous row; its odometry then repeats the motion of that row.
    """
    motion = motions_between(pose)
    if kidnapped is not None:
        for row in np.flatnonzero(kidnapped[1:]):
            motion[row] = motion[row - 1] if row else 0.0
    measured = np.zeros((len(time), 4))
    measured[1:, :3] = OdometryErrors(config, random).add_to(time, motion)
    measured[1:, 3] = np.diff(time)
    return measured


def motions_between(pose: np.ndarray) -> np.ndarray:
    """[N - 1, 3] motions (m, m, rad) between successive poses [N, 3]; the turns are not wrapped, as the
    headings."""
    motion = between(pose[:-1], pose[1:])
    motion[:, 2] = np.diff(pose[:, 2])
    return motion


class OdometryErrors:
    """Odometry errors of a path that may be given in parts, at a cost in proportion to each part.

    Errors are drawn at the odometry rate, at ticks, and interpolated to the rows. Of what went before, only
    what the next part needs is kept: the rows and draws since the last tick before the end.

    Args:
        random: all errors are drawn from it, in order, so that they do not depend on the later parts.
    """

    def __init__(self, config: OdometryConfig, random: np.random.Generator) -> None:
        self._config, self._random = config, random
        self._scale = 1 + config.length_bias * random.standard_normal()
        self._bent = config.heading_bias * random.standard_normal()
        self._start: float | None = None  # time of tick 0, s
        self._tick = 0  # number of the first tick kept
        self._draws = np.zeros((0, 2))  # of the ticks from that one on
        self._base = np.zeros((1, 2))  # sum of the errors up to that tick
        self._time = np.zeros(0)  # of the rows kept, s
        self._amount = np.zeros((1, 2))  # way (m) and turn (rad) from the start to each of them

    def add_to(self, time: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """[N - 1, 3] motions (m, m, rad) with errors, turns wrapped.

        Args:
            time: [N] s; the first is the last of the part before. motion: [N - 1, 3] true motions.
        """
        measured = motion.copy()
        measured[:, 2] += self._bent * np.hypot(motion[:, 0], motion[:, 1])
        measured[:, :2] *= self._scale
        measured[:, [0, 2]] += self._errors(time, measured)
        measured[:, 2] = wrap(measured[:, 2])
        return measured

    def _errors(self, time: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """[N - 1, 2] errors of forward motion (m) and turn (rad)."""
        config = self._config
        if config.noise == "none" or len(time) < 2:
            return np.zeros((len(motion), 2))
        if self._start is None:
            self._start, self._time = float(time[0]), time[:1]
        amount = np.abs(np.stack([np.hypot(motion[:, 0], motion[:, 1]), motion[:, 2]], axis=1))
        self._amount = np.concatenate([self._amount, np.cumsum([self._amount[-1], *amount], axis=0)[1:]])
        self._time = np.concatenate([self._time, time[1:]])
        count = int(np.ceil((time[-1] - self._start) * config.rate)) + 1
        drawn = self._random.standard_normal((count + 1 - self._tick - len(self._draws), 2))
        self._draws = np.concatenate([self._draws, drawn * [config.length, config.heading]])
        ticks = self._start + np.arange(self._tick, count + 1) / config.rate
        total = self._totals(ticks)
        errors = np.stack([np.diff(np.interp(time, ticks, column)) for column in total.T], axis=1)
        self._forget(ticks, total)
        return errors

    def _totals(self, ticks: np.ndarray) -> np.ndarray:
        """[T, 2] sums of the errors from the start to the ticks."""
        config = self._config
        if config.noise == "telescoping":
            return self._draws
        gate = np.ones((len(ticks) - 1, 2), bool)
        if config.noise == "gated":
            moved = [np.diff(np.interp(ticks, self._time, column)) for column in self._amount.T]
            gate = np.stack(moved, axis=1) * config.rate > [DRIVING_SPEED, TURNING_RATE]
        return np.cumsum(np.concatenate([self._base, self._draws[1:] * gate]), axis=0)

    def _forget(self, ticks: np.ndarray, total: np.ndarray) -> None:
        """Drops the rows and ticks before the last tick up to the last row; nothing there can change."""
        past = int(np.searchsorted(ticks, self._time[-1], side="right")) - 1
        row = int(np.searchsorted(self._time, ticks[past], side="right")) - 1
        self._tick += past
        self._draws, self._base = self._draws[past:].copy(), total[past : past + 1].copy()
        self._time, self._amount = self._time[row:].copy(), self._amount[row:].copy()


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
    return [
        observation._replace(odometry=Odometry(dx, dy, dtheta, observation.odometry.dt))
        for observation, (dx, dy, dtheta) in zip(observations, corrected, strict=True)
    ]


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
