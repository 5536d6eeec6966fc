"""The route of an arm that drives to goals: each estimate aims the arm anew."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from robot.drivers.ur10.base_transform import tcp_from_pose
from robot.drivers.ur10.safety import TargetRefused
from robot.live.arm_route import MovableArm, route_speed
from robot.live.goal_drive import DriveState, GoalDrive, Sighting, points_in_map
from robot.live.live_config import LiveConfig
from tactile.base.se2 import between, compose, wrap

GAIN = 0.1
"""Least share of the difference between estimate and expected pose that a whisk takes up."""
OUTLIER = np.array([0.03, 0.03, 0.1])
"""Largest difference (m, m, rad) that is taken up; what exceeds it is an outlier (Huber 1964). Odometry with
the errors of a mobile robot is wrong by up to 0.6 rad after a turn, until recall corrects it."""
SETTLED = 5
"""Whisks after which differences are limited so."""
RECENT = 8
"""Whisks whose contacts are aligned with those of the map."""
MOVED = 5
"""Consecutive whisks elsewhere after which the robot has been moved."""
NEW = 0.04
"""Distance from an obstacle within which contacts are its own, m."""
SAME, SAME_TURN = 0.005, 0.03
"""Change of the target below which the present move goes on, m and rad."""


class ContactMap(Protocol):
    """Contacts remembered in a map."""

    def align(self, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        """The pose near a pose [3] in the map from which contacts [n, 2] in base_link (m) fit best."""
        ...

    def agrees(self, pose: np.ndarray, points: np.ndarray) -> bool:
        """Whether contacts [n, 2] in base_link (m), seen from a pose [3] in the map, fit the map."""
        ...


class NoContacts(ContactMap):
    """Those of a map without contacts: nothing is aligned or denied."""

    def align(self, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        del points
        return pose

    def agrees(self, pose: np.ndarray, points: np.ndarray) -> bool:
        del pose, points
        return True


class GoalRoute:
    """Moves the arm as a drive decides; without a target it halts the arm.

    The map and the arm have frames of their own. The arm's own motion is far more accurate than one estimate:
    the pose to steer by moves with the arm and takes up a share of its difference to each estimate: 1 / n in
    the n-th whisk, which is the mean of all, and at least `GAIN`. A difference of more than `jump` (m) in
    `MOVED` whisks is taken up at once: the robot is elsewhere; but contacts that agree with the map at the
    pose and not at the estimate deny it. Without estimates the arm's motion alone leads
    on for `coast` (m), as long as the contacts of the last whisks agree with the map; then the head rests. A
    pose is sure if the estimate is within `jump` of it and the contacts agree.

    Args:
        contacts: those of the map, with which the last ones are aligned; recall does not do so.

    Attributes:
        drive: what decides. pose: [3] in the map to steer by; None before the first estimate.
    """

    def __init__(
        self,
        drive: GoalDrive,
        config: LiveConfig,
        jump: float,
        coast: float,
        contacts: ContactMap | None = None,
    ) -> None:
        self.drive = drive
        self.pose: np.ndarray | None = None
        self._placing, self._speed, self._jump = config.arm.placing, route_speed(config), jump
        self._contacts = contacts or NoContacts()
        self._recent: list[tuple[np.ndarray, np.ndarray]] = []  # arm's pose and contacts of the last whisks
        self._coast, self._unseen = coast, 0.0  # way without an estimate, m
        self._count = self._elsewhere = 0  # whisks since the last jump; of them in a row elsewhere
        self._arm_pose: np.ndarray | None = None  # in the whisk of that pose
        self._target: np.ndarray | None = None  # [3] by the arm
        self._sent: np.ndarray | None = None

    def see(
        self, estimate: np.ndarray | None, points: np.ndarray, arm_pose: np.ndarray, arm_now: np.ndarray
    ) -> DriveState:
        """Takes the result of a whisk.

        Args:
            estimate: [3] of the whisk in the map; None without one. points: [n, 2] contacts in base_link, m.
            arm_pose, arm_now: [3] poses by the arm, in that whisk and now.
        """
        if self.drive.state is DriveState.REACHED and not self.drive.finished:
            self.drive.next_goal()
        self._target = None
        if self.pose is not None and self._arm_pose is not None:
            step = between(self._arm_pose, arm_pose)
            self.pose = compose(self.pose, step)
            self._unseen += float(np.hypot(step[0], step[1]))
        self._arm_pose = arm_pose
        self._recent = [*self._recent, (arm_pose, points)][-RECENT:]
        if estimate is not None and not self._correct(estimate, self._recent_points(arm_pose)):
            estimate = None
        sure = self.pose is not None and self._align(estimate, arm_pose)
        if self.pose is None or (estimate is None and self._unseen > self._coast):
            self.pose = None
            return self.rest()
        now = compose(self.pose, between(arm_pose, arm_now))
        state = self.drive.observe(Sighting(now, points_in_map(self.pose, points), sure))
        if self.drive.target is not None:
            self._target = compose(arm_now, between(now, self.drive.target))
        return state

    def rest(self) -> DriveState:
        """A whisk stays without any result: the arm rests."""
        self._target = None
        return self.drive.observe(Sighting(None, np.zeros((0, 2))))

    def _align(self, estimate: np.ndarray | None, arm_pose: np.ndarray) -> bool:
        """Aligns the last contacts with those of the map; returns whether the pose is sure then."""
        assert self.pose is not None
        points = self._recent_points(arm_pose)
        self.pose = self._contacts.align(self.pose, points)
        agrees = self._contacts.agrees(self.pose, self._without_obstacles(points))
        if estimate is None:
            self._unseen = self._unseen if agrees else np.inf
            return False
        return agrees and bool(np.hypot(*(self.pose - estimate)[:2]) <= self._jump)

    def _without_obstacles(self, points: np.ndarray) -> np.ndarray:
        """The points [n, 2] in base_link that are not at obstacles found on the way, which the map does not
        have."""
        assert self.pose is not None
        found = self.drive.obstacles
        away = np.linalg.norm(points_in_map(self.pose, points)[:, None] - found, axis=-1)
        return points[(away > NEW).all(axis=1)]

    def _recent_points(self, arm_pose: np.ndarray) -> np.ndarray:
        """[n, 2] contacts of the last whisks, as seen from a pose of the arm, m."""
        seen = [points_in_map(between(arm_pose, before), points) for before, points in self._recent]
        return np.concatenate(seen)

    def _correct(self, estimate: np.ndarray, points: np.ndarray) -> bool:
        """Moves the pose towards the estimate, unless only the pose as it is agrees with the last contacts
        [n, 2] in base_link, m; returns whether it did."""
        apart = np.zeros(3) if self.pose is None else between(self.pose, estimate)
        self._elsewhere = self._elsewhere + 1 if np.hypot(apart[0], apart[1]) > self._jump else 0
        if self.pose is not None and self._elsewhere and self._denies(estimate, points):
            return False
        self._unseen, self._count = 0.0, self._count + 1
        if self.pose is None or self._elsewhere >= MOVED:
            self.pose, self._count, self._elsewhere = estimate, 1, 0
            return True
        share = max(GAIN, 1 / self._count)
        most = OUTLIER if self._count > SETTLED else np.full(3, np.inf)
        self.pose = compose(self.pose, share * np.clip(apart, -most, most))
        return True

    def _denies(self, estimate: np.ndarray, points: np.ndarray) -> bool:
        """Whether contacts agree with the map at the pose and not at the estimate."""
        assert self.pose is not None
        here, there = (self._contacts.align(pose, points) for pose in (self.pose, estimate))
        return self._contacts.agrees(here, points) and not self._contacts.agrees(there, points)

    def advance(self, arm: MovableArm) -> bool:
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
                self._target = None
                if self.pose is not None:
                    self.drive.refuse(self.pose)
        return False

    def resend_last(self) -> None:
        """Sends the target again with the next `advance`, after a stop."""
        self._sent = None


def _differ(a: np.ndarray, b: np.ndarray) -> bool:
    return bool(np.hypot(*(a[:2] - b[:2])) > SAME or abs(wrap(a[2] - b[2])) > SAME_TURN)
