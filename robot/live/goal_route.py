"""The route of an arm that drives to goals: each estimate aims the arm anew."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from robot.drivers.outcome import Fault
from robot.drivers.ur10.base_transform import tcp_from_pose
from robot.drivers.ur10.safety import TargetRefused
from robot.live.config import LiveConfig
from robot.live.goal_drive import DriveState, GoalDrive, Sighting
from robot.live.route import route_speed
from tactile.base.se2 import between, compose, wrap

SAME, SAME_TURN = 0.005, 0.03
"""Change of the target below which the present move goes on, m and rad."""


class SteeredArm(Protocol):
    """The parts of `robot.drivers.ur10.arm.Arm` that the route uses."""

    @property
    def fault(self) -> Fault | None: ...
    def move(self, tcp: np.ndarray, speed: float | None = None) -> object: ...
    def halt(self) -> None: ...


class GoalRoute:
    """Moves the arm as a drive decides; without a target it halts the arm.

    The map and the arm have frames of their own: the estimate of a whisk and the arm's pose in that whisk
    give the motion between them, anew with each estimate.

    Attributes:
        drive: what decides. log: one entry for each goal that has ended.
    """

    def __init__(self, drive: GoalDrive, config: LiveConfig) -> None:
        self.drive = drive
        self._placing, self._speed = config.arm.placing, route_speed(config)
        self._seen: np.ndarray | None = None  # the last estimate
        self._target: np.ndarray | None = None  # [3] by the arm
        self._sent: np.ndarray | None = None

    def see(self, sighting: Sighting, arm_pose: np.ndarray) -> DriveState:
        """Takes the sighting of a whisk, and the arm's pose [3] in it."""
        if self.drive.state is DriveState.REACHED and not self.drive.finished:
            self.drive.next_goal()
        state = self.drive.observe(sighting)
        target, self._seen = self.drive.target, sighting.pose
        self._target = None
        if target is not None and sighting.pose is not None:
            self._target = compose(arm_pose, between(sighting.pose, target))
        return state

    def advance(self, arm: SteeredArm) -> bool:
        """Sends the newest target, or halts the arm without one; returns whether the drive has ended.

        A target that the checks of the arm refuse blocks the way there.

        Raises:
            TargetRefused: the arm has a fault.
        """
        if self._target is None:
            if self._sent is not None:
                arm.halt()
                self._sent = None
            return self.drive.finished
        if self._sent is None or _differ(self._sent, self._target):
            try:
                arm.move(tcp_from_pose(self._placing, self._target), self._speed)
                self._sent = self._target
            except TargetRefused:
                if arm.fault is not None:
                    raise
                assert self._seen is not None
                self.drive.refuse(self._seen)
                self._target = None
        return False

    def resend_last(self) -> None:
        """Sends the target again with the next `advance`, after a stop."""
        self._sent = None


def _differ(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.hypot(*(a[:2] - b[:2])) > SAME or abs(wrap(a[2] - b[2])) > SAME_TURN)
