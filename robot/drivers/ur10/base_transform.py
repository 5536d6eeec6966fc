"""Transform between poses of the head in the map and tool poses in the arm's base frame.

A tool pose is an array [..., 6] in UR controllers' notation: x, y, z of the tool centre point in the base
frame, m, and a rotation vector, rad. The tool points down: its rotation is Rz(heading) Rx(pi), half a turn
about the level axis (cos h/2, sin h/2, 0).
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from tactile.base.se2 import between, compose
from tactile.base.settings import Settings


class BaseTransformConfig(Settings):
    """Pose of the map in the arm's base frame.

    The default sets a maze of 7 x 5 micromouse cells before the base, within a UR-10's reach.
    """

    x: float = -0.63
    """x of the map's origin, m."""
    y: float = 0.22
    """y of the map's origin, m."""
    z: float = 0.1
    """Height of the tool centre point at working height, m."""
    yaw_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """Angle from the base's x axis to the map's, degrees."""


def tcp_from_pose(
    config: BaseTransformConfig, pose: np.ndarray, lift: float | np.ndarray = 0.0
) -> np.ndarray:
    """Tool poses [..., 6] for poses of the head in the map.

    Args:
        pose: [..., 3] x, y (m) and heading (rad) in the map. lift: [...] m above working height.
    """
    x, y, heading = np.moveaxis(compose(_origin(config), np.asarray(pose, np.float64)), -1, 0)
    z = np.broadcast_to(config.z + np.asarray(lift, np.float64), x.shape)
    axis = np.pi * np.cos(heading / 2), np.pi * np.sin(heading / 2)
    return np.stack([x, y, z, *axis, np.zeros_like(x)], axis=-1)


def pose_from_tcp(config: BaseTransformConfig, tcp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the head in the map [..., 3], heading wrapped, and its lift above working height [...] m."""
    tcp = np.asarray(tcp, np.float64)
    pose = np.stack([tcp[..., 0], tcp[..., 1], tcp_heading(tcp)], axis=-1)
    return between(_origin(config), pose), tcp[..., 2] - config.z


def tcp_heading(tcp: np.ndarray) -> np.ndarray:
    """Heading of the tool's x axis in the base frame, seen from above, [...] rad."""
    axis, turn = _axis_angle(tcp)
    x, y, z = np.moveaxis(axis, -1, 0)
    cos, sin = np.cos(turn), np.sin(turn)
    return np.arctan2(z * sin + x * y * (1 - cos), cos + x * x * (1 - cos))


def tcp_tilt(tcp: np.ndarray) -> np.ndarray:
    """Angle between the tool's z axis and straight down, [...] rad."""
    axis, turn = _axis_angle(tcp)
    up = np.cos(turn) + axis[..., 2] ** 2 * (1 - np.cos(turn))
    return np.arccos(np.clip(-up, -1.0, 1.0))


def _axis_angle(tcp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation axis [..., 3] of unit length (any for no rotation) and angle [...] rad."""
    vector = np.asarray(tcp, np.float64)[..., 3:]
    turn = np.linalg.norm(vector, axis=-1)
    return vector / np.where(turn > 0, turn, 1.0)[..., None], turn


def _origin(config: BaseTransformConfig) -> np.ndarray:
    return np.array([config.x, config.y, np.radians(config.yaw_deg)])
