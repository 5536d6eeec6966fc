"""Where an emulated head is: where an arm has it, along a way of its own, or where it stands."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from robot.drivers.ur10.base_transform import BaseTransformConfig, pose_from_tcp
from robot.world.head_trajectory import HeadPath, poses_at

AHEAD = 0.1
"""s for which an arm's speed is believed; then it counts as standing where that led."""


class PoseSource(Protocol):
    """Where the head is, as time goes on."""

    def at(self, time: float) -> tuple[np.ndarray, float]:
        """The pose in the map [3] (m, m, rad), and how far the head is lifted above working height, m.

        Args:
            time: s, host's monotonic clock.
        """
        ...


class ToolPoses(Protocol):
    """An arm's newest state: `robot.drivers.ur10.pose_listener.ToolPoseStream`."""

    def latest(self) -> tuple[float, np.ndarray, np.ndarray] | None:
        """Host's time of receipt (s), tool pose [6] and its speed [6]; None before the first."""
        ...


class CarriedByArm:
    """By an arm: its newest pose, and onwards by its speed."""

    def __init__(self, arm: ToolPoses, placing: BaseTransformConfig) -> None:
        self.arm, self.placing = arm, placing

    def at(self, time: float) -> tuple[np.ndarray, float]:
        told = self.arm.latest()
        if told is None:
            return np.zeros(3), np.inf
        since, tcp, speed = told
        ahead = min(max(time - since, -AHEAD), AHEAD)
        tool = np.array(tcp, float)
        tool[:3] += ahead * np.asarray(speed)[:3]
        pose, lift = pose_from_tcp(self.placing, tool)
        # The axes of turning and of the map's headings are both vertical.
        return pose + np.array([0.0, 0.0, ahead * float(speed[5])]), float(lift)


class AlongPath:
    """Along a path, from a time on that `begin` tells once; before, where it begins."""

    def __init__(self, path: HeadPath) -> None:
        self.path = path
        self.began: float | None = None

    def begin(self, time: float) -> None:
        """Sets out, if it has not yet."""
        self.began = time if self.began is None else self.began

    def at(self, time: float) -> tuple[np.ndarray, float]:
        since = 0.0 if self.began is None else time - self.began
        return poses_at(self.path, np.array(since)), 0.0
