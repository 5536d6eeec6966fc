"""Body-frame motion from logged velocities, motions or poses, and simulated odometry errors.

A motion is a row (dx m, dy m, dtheta rad, dt s): the pose after a step in the frame of the pose before it.
The first row only sets the clock: its motion and duration are zero.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from robot.sources.source import Source
from tactile.base.config import Settings
from tactile.base.se2 import between, integrate, wrap

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
    motion = between(pose[:-1], pose[1:])
    motion[:, 2] = np.diff(pose[:, 2])
    if kidnapped is not None:
        for row in np.flatnonzero(kidnapped[1:]):
            motion[row] = motion[row - 1] if row else 0.0
    scale = 1 + config.length_bias * random.standard_normal()
    bent = config.heading_bias * random.standard_normal()
    motion[:, 2] += bent * np.hypot(motion[:, 0], motion[:, 1])
    motion[:, :2] *= scale
    measured = np.zeros((len(time), 4))
    measured[1:, :3] = motion
    measured[1:, [0, 2]] += _errors(config, time, motion, random)
    measured[1:, 2] = wrap(measured[1:, 2])
    measured[1:, 3] = np.diff(time)
    return measured


def _errors(
    config: OdometryConfig, time: np.ndarray, motion: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """[N - 1, 2] errors of forward motion (m) and turn (rad). Errors are drawn at the odometry rate and
    interpolated to the rows."""
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
    """Largest distance from the start along either axis of the start frame, from odometry, m."""
    moves = np.array([sample.reading.odometry[:3] for sample in source], float).reshape(-1, 3)
    path = integrate(np.where(np.isfinite(moves), moves, 0.0), np.zeros(3))
    return float(np.abs(path[:, :2]).max(initial=0.0))
