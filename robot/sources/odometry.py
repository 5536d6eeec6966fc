"""Body-frame motions: of what robots log, velocities or poses, and of what a simulated one believes.

A motion is a row (dx m, dy m, dtheta rad, dt s), the pose after a step in the frame of the pose before
it. The first row of a log only sets the clock: its motion is zero and took no time.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from robot.sources.source import Source
from tactile.base.config import Settings
from tactile.base.se2 import between, integrate, wrap

TURN_THEN_MOVE = 1.0  # OpenRatSLAM: turn first, then move
MIDPOINT = 0.5  # second order: exact to O(turn^2) for a constant twist over the step
DRIVING_SPEED = 1e-3
"""m/s above which a robot is driving."""
TURNING_RATE = 0.06
"""rad/s above which it is turning."""


def from_velocities(
    time: np.ndarray,
    forward: np.ndarray,
    left: np.ndarray | float,
    turn: np.ndarray,
    heading: float = MIDPOINT,
) -> np.ndarray:
    """Motions [N, 4] of a robot that had row i's velocities since row i - 1.

    Args:
        time: [N] s. forward, left: [N] m/s in the body frame. turn: [N] rad/s, counter-clockwise.
        heading: the share of the step's turn made before the robot moves: `MIDPOINT`, or
            `TURN_THEN_MOVE` as in OpenRatSLAM.
    """
    dt = np.diff(time, prepend=time[:1])
    dtheta = turn * dt
    c, s = np.cos(heading * dtheta), np.sin(heading * dtheta)
    return np.stack([(c * forward - s * left) * dt, (s * forward + c * left) * dt, dtheta, dt], axis=-1)


def from_poses(time: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Motions [N, 4] between successive poses [N, 3] of a world frame, the sideways part kept."""
    steps = between(poses[:-1], poses[1:])
    return np.column_stack([np.vstack([np.zeros((1, 3)), steps]), np.diff(time, prepend=time[:1])])


class OdometryConfig(Settings):
    """Errors of the UR-10's odometry (Salman & Pearson 2016, III-C, where their structure is left open)."""

    noise: Literal["white", "gated", "telescoping", "none"] = "gated"
    """`white`: in every sample; `gated`: only along what moves; `telescoping`: of the poses, so that it does
    not add up (jitter of time stamps)."""
    rate: PositiveFloat = 1.0
    """Samples per second."""
    length: NonNegativeFloat = 8.2e-3
    """Standard deviation of a sample, m."""
    heading: NonNegativeFloat = 0.103
    """Of its turn, rad."""
    length_bias: NonNegativeFloat = 0.0
    """Standard deviation of a scale error of all lengths of a run, as a share."""
    heading_bias: NonNegativeFloat = 0.0
    """Of a heading error that grows with the way in a run, rad/m."""


def simulate_odometry(
    config: OdometryConfig,
    time: np.ndarray,
    pose: np.ndarray,
    random: np.random.Generator,
    carried: np.ndarray | None = None,
) -> np.ndarray:
    """[N, 4] (dx m, dy m, dtheta rad, dt s) since the row before, as the odometry tells it.

    Args:
        time: [N] s. pose: [N, 3] true, headings not wrapped. carried: [N] bool, the robot was carried since
            the row before, unknown to its odometry: told is the motion of the row before that.
    """
    motion = between(pose[:-1], pose[1:])
    motion[:, 2] = np.diff(pose[:, 2])
    if carried is not None:
        for row in np.flatnonzero(carried[1:]):
            motion[row] = motion[row - 1] if row else 0.0
    scale = 1 + config.length_bias * random.standard_normal()
    bent = config.heading_bias * random.standard_normal()
    motion[:, 2] += bent * np.hypot(motion[:, 0], motion[:, 1])
    motion[:, :2] *= scale
    told = np.zeros((len(time), 4))
    told[1:, :3] = motion
    told[1:, [0, 2]] += _errors(config, time, motion, random)
    told[1:, 2] = wrap(told[1:, 2])
    told[1:, 3] = np.diff(time)
    return told


def _errors(
    config: OdometryConfig, time: np.ndarray, motion: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """[N - 1, 2] errors ahead (m) and of the turn (rad). Samples have their own rate: what falls between two
    rows is shared out evenly."""
    if config.noise == "none" or len(time) < 2:
        return np.zeros((len(motion), 2))
    count = int(np.ceil((time[-1] - time[0]) * config.rate)) + 1
    ticks = time[0] + np.arange(count + 1) / config.rate
    error = random.standard_normal((count + 1, 2)) * [config.length, config.heading]
    if config.noise == "telescoping":
        total = error
    else:
        gate = np.ones((count, 2), bool)
        if config.noise == "gated":
            amount = np.abs(np.stack([np.hypot(motion[:, 0], motion[:, 1]), motion[:, 2]], axis=1))
            total = np.concatenate([np.zeros((1, 2)), np.cumsum(amount, axis=0)])
            moved = np.stack([np.diff(np.interp(ticks, time, column)) for column in total.T], axis=1)
            gate = moved * config.rate > [DRIVING_SPEED, TURNING_RATE]
        total = np.concatenate([np.zeros((1, 2)), np.cumsum(error[1:] * gate, axis=0)])
    return np.stack([np.diff(np.interp(time, ticks, column)) for column in total.T], axis=1)


def odometry_extent(source: Source) -> float:
    """Largest distance from the start along either axis of the frame that it starts in, m."""
    moves = np.array([sample.reading.odometry[:3] for sample in source], float).reshape(-1, 3)
    path = integrate(np.where(np.isfinite(moves), moves, 0.0), np.zeros(3))
    return float(np.abs(path[:, :2]).max(initial=0.0))
