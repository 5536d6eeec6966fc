"""Pose of an emulated head: carried by an arm, along a path, or fixed."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from robot.drivers.ur10.base_transform import BaseTransformConfig, pose_from_tcp
from robot.drivers.ur10.pose_listener import PoseListener
from robot.world.head_trajectory import HeadPath, poses_at

AHEAD = 0.1
"""Longest extrapolation of a pose by the arm's speed, s; after that the head stands still."""


class PoseSource(Protocol):
    """Pose of the head over time."""

    def at(self, time: float) -> tuple[np.ndarray, float]:
        """Pose in the map [3] (m, m, rad) and lift above working height, m.

        Args:
            time: s, host's monotonic clock.
        """
        ...


class CarriedByArm:
    """The newest pose of an arm, extrapolated by its speed."""

    def __init__(self, arm: PoseListener, placing: BaseTransformConfig) -> None:
        self.arm, self.placing = arm, placing

    def at(self, time: float) -> tuple[np.ndarray, float]:
        newest = self.arm.latest()
        if newest is None:
            return np.zeros(3), np.inf
        ahead = min(max(time - newest.time, -AHEAD), AHEAD)
        tool = np.array(newest.tcp, float)
        tool[:3] += ahead * newest.speed[:3]
        pose, lift = pose_from_tcp(self.placing, tool)
        # The rotation axes of the arm and of the map's headings are both vertical.
        return pose + np.array([0.0, 0.0, ahead * float(newest.speed[5])]), float(lift)


class AlongPath:
    """A motion along a path that starts at the time given to `begin`; before, the path's first pose."""

    def __init__(self, path: HeadPath) -> None:
        self.path = path
        self.began: float | None = None

    def begin(self, time: float) -> None:
        """Starts the motion at a time, s; later calls have no effect."""
        self.began = time if self.began is None else self.began

    def at(self, time: float) -> tuple[np.ndarray, float]:
        since = 0.0 if self.began is None else time - self.began
        return poses_at(self.path, np.array(since)), 0.0
