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

GAIN = 0.15
"""Share of the difference between estimate and expected pose that each whisk takes up."""
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

    The map and the arm have frames of their own. The arm's own motion is far more accurate than one estimate:
    the pose to steer by is the arm's motion since the last whisk, corrected by the share `GAIN` of its
    difference to the estimate. A difference of more than `jump` (m) is taken up at once: the robot is
    elsewhere.

    Attributes:
        drive: what decides. pose: [3] in the map to steer by; None before the first estimate.
    """

    def __init__(self, drive: GoalDrive, config: LiveConfig, jump: float) -> None:
        self.drive = drive
        self.pose: np.ndarray | None = None
        self._placing, self._speed, self._jump = config.arm.placing, route_speed(config), jump
        self._arm_pose: np.ndarray | None = None  # in the whisk of that pose
        self._target: np.ndarray | None = None  # [3] by the arm
        self._sent: np.ndarray | None = None

    def see(self, sighting: Sighting, arm_pose: np.ndarray) -> DriveState:
        """Takes the sighting of a whisk, and the arm's pose [3] in it."""
        if self.drive.state is DriveState.REACHED and not self.drive.finished:
            self.drive.next_goal()
        if sighting.pose is not None:
            self._correct(sighting.pose, arm_pose)
            sighting = sighting._replace(pose=self.pose)
        state, target = self.drive.observe(sighting), self.drive.target
        self._target = None
        if target is not None and self.pose is not None:
            self._target = compose(arm_pose, between(self.pose, target))
        return state

    def _correct(self, estimate: np.ndarray, arm_pose: np.ndarray) -> None:
        """Moves the pose with the arm and towards the estimate."""
        pose = estimate
        if self.pose is not None and self._arm_pose is not None:
            expected = compose(self.pose, between(self._arm_pose, arm_pose))
            apart = between(expected, estimate)
            if np.hypot(apart[0], apart[1]) <= self._jump:
                pose = compose(expected, GAIN * apart)
        self.pose, self._arm_pose = pose, arm_pose

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
                assert self.pose is not None
                self.drive.refuse(self.pose)
                self._target = None
        return False

    def resend_last(self) -> None:
        """Sends the target again with the next `advance`, after a stop."""
        self._sent = None


def _differ(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.hypot(*(a[:2] - b[:2])) > SAME or abs(wrap(a[2] - b[2])) > SAME_TURN)
