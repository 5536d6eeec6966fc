"""Poses and velocities in the messages of a topic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tactile.base.errors import InputError

ODOMETRY = "nav_msgs/msg/Odometry"


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Heading of a quaternion, rad in [-pi, pi]: the direction of its x axis in the plane."""
    return float(np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z))


def pose_in_plane(position: Any, orientation: Any, where: str) -> tuple[float, float, float]:
    """(x m, y m, heading rad) of a position and a quaternion.

    Raises:
        InputError: the quaternion is 0.
    """
    turn = tuple(float(getattr(orientation, axis)) for axis in "xyzw")
    if not any(turn):
        raise InputError(where, "the orientation is 0, 0, 0, 0", "a unit quaternion")
    return float(position.x), float(position.y), yaw_of(*turn)


def _of_pose(pose: Any, where: str) -> tuple[float, float, float]:
    return pose_in_plane(pose.position, pose.orientation, where)


def _of_transform(transform: Any, where: str) -> tuple[float, float, float]:
    return pose_in_plane(transform.translation, transform.rotation, where)


POSES: dict[str, Callable[[Any, str], tuple[float, float, float]]] = {
    ODOMETRY: lambda message, where: _of_pose(message.pose.pose, where),
    "geometry_msgs/msg/PoseStamped": lambda message, where: _of_pose(message.pose, where),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message, where: _of_pose(message.pose.pose, where),
    "geometry_msgs/msg/TransformStamped": lambda message, where: _of_transform(message.transform, where),
}
"""Message types with a pose, and how it is read."""

TWISTS: dict[str, Callable[[Any], Any]] = {
    ODOMETRY: lambda message: message.twist.twist,
    "geometry_msgs/msg/TwistStamped": lambda message: message.twist,
}
"""Message types with velocities in the frame of the robot."""


def twist_in_plane(twist: Any) -> tuple[float, float, float]:
    """(forward m/s, left m/s, turn rad/s) of a twist."""
    return float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)
