"""Poses and velocities in the messages of a topic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from robot.recordings.sanity_checks import still_axis
from tactile.base.errors import InputError

ODOMETRY = "nav_msgs/msg/Odometry"


def frames_of(message: Any) -> tuple[str, str]:
    """Frame and child frame of a message, without leading slashes; '' where it names none."""
    frame, child = str(message.header.frame_id), str(getattr(message, "child_frame_id", ""))
    return frame.lstrip("/"), child.lstrip("/")


def yaw_of(x: float, y: float, z: float, w: float) -> float:
    """Heading of a quaternion, rad in [-pi, pi]: the direction of its x axis in the plane."""
    return float(np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z))


def pose_in_plane(
    position: Any, orientation: Any, where: str, plane: str = "xy"
) -> tuple[float, float, float]:
    """(x m, y m, heading rad) of a position and a quaternion.

    Args:
        plane: `xy`; `xz` of a camera (x to the right, y down, z ahead): x = z, y = -x, heading of its z axis.

    Raises:
        InputError: the quaternion is 0, or a number is not finite.
    """
    turn = tuple(float(getattr(orientation, axis)) for axis in "xyzw")
    if not any(turn):
        cure = "of odometry, the velocities remain: --set recording.topics.odometry.use=twist"
        raise InputError(where, "the orientation is 0, 0, 0, 0", "a unit quaternion", cure)
    place = tuple(float(getattr(position, axis)) for axis in plane)
    for name, values in (("orientation", turn), ("position", place)):
        if not np.isfinite(values).all():
            raise InputError(where, f"the {name} is {', '.join(map(str, values))}", "finite numbers")
    if plane == "xz":
        x, y, z, w = turn
        return place[1], -place[0], float(np.arctan2(-2 * (x * z + w * y), w * w + z * z - x * x - y * y))
    return place[0], place[1], yaw_of(*turn)


POSES: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    ODOMETRY: lambda message: (message.pose.pose.position, message.pose.pose.orientation),
    "geometry_msgs/msg/PoseStamped": lambda message: (message.pose.position, message.pose.orientation),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: (
        message.pose.pose.position,
        message.pose.pose.orientation,
    ),
    "geometry_msgs/msg/TransformStamped": lambda message: (
        message.transform.translation,
        message.transform.rotation,
    ),
}
"""Message types with a pose: its position and orientation."""


TWISTS: dict[str, Callable[[Any], Any]] = {
    ODOMETRY: lambda message: message.twist.twist,
    "geometry_msgs/msg/TwistStamped": lambda message: message.twist,
}
"""Message types with velocities in the frame of the robot."""


def plane_errors(points: np.ndarray, where: str, role: str, plane: str) -> list[InputError]:
    """The error for positions [M, 3] that lie in another plane than x and y; another one is taken as told."""
    still = still_axis(points) if plane == "xy" and len(points) > 1 else ""
    if not still:
        return []
    x, y, z = np.ptp(points, axis=0)
    found = f"the path spans {x:.3g} m in x, {y:.3g} m in y and {z:.3g} m in z: another plane"
    camera = f"if the poses are a camera's (z ahead), --set recording.topics.{role}.plane=xz"
    cure = camera if still == "y" else "turn the poses into the plane of x and y"
    return [InputError(where, found, "a path in the plane of x and y", cure)]


def twist_in_plane(twist: Any) -> tuple[float, float, float]:
    """(forward m/s, left m/s, turn rad/s) of a twist."""
    return float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)
