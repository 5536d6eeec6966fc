"""Body-frame motions from what robots log: velocities or poses.

A motion is a row (dx m, dy m, dtheta rad, dt s), the pose after a step in the frame of the pose before
it. The first row of a log only sets the clock: its motion is zero and took no time.
"""

from __future__ import annotations

import numpy as np

from tactile.frames import between

NEW_HEADING = 1.0  # OpenRatSLAM: turn first, then move
MID_HEADING = 0.5  # second order: exact to O(turn^2) for a constant twist over the step


def from_velocities(
    time: np.ndarray,
    forward: np.ndarray,
    left: np.ndarray | float,
    turn: np.ndarray,
    heading: float = MID_HEADING,
) -> np.ndarray:
    """Motions [N, 4] of a robot that had row i's velocities since row i - 1.

    Args:
        time: [N] s. forward, left: [N] m/s in the body frame. turn: [N] rad/s, counter-clockwise.
        heading: the share of the step's turn made before the robot moves: `MID_HEADING`, or
            `NEW_HEADING` as in OpenRatSLAM.
    """
    dt = np.diff(time, prepend=time[:1])
    dtheta = turn * dt
    c, s = np.cos(heading * dtheta), np.sin(heading * dtheta)
    return np.stack([(c * forward - s * left) * dt, (s * forward + c * left) * dt, dtheta, dt], axis=-1)


def from_poses(time: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Motions [N, 4] between successive poses [N, 3] of a world frame, the sideways part kept."""
    steps = between(poses[:-1], poses[1:])
    return np.column_stack([np.vstack([np.zeros((1, 3)), steps]), np.diff(time, prepend=time[:1])])
