"""Odometry errors of the UR-10 that carries the head (Salman & Pearson 2016, III-C), simulated and emulated.

A motion is a row (m, m, rad): the pose after a step in the frame of the pose before it.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from tactile.base.se2 import between, wrap
from tactile.base.settings import Settings

DRIVING_SPEED = 1e-3
"""Speed above which a robot counts as driving, m/s."""
TURNING_RATE = 0.06
"""Turn rate above which a robot counts as turning, rad/s."""


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
        # Rows and ticks before the last tick up to the last row are dropped: nothing there can change.
        past = int(np.searchsorted(ticks, self._time[-1], side="right")) - 1
        row = int(np.searchsorted(self._time, ticks[past], side="right")) - 1
        self._tick += past
        self._draws, self._base = self._draws[past:].copy(), total[past : past + 1].copy()
        self._time, self._amount = self._time[row:].copy(), self._amount[row:].copy()
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
