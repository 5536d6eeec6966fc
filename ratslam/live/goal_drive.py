"""Driving to goals on a map, whisk by whisk: decides from estimates and contacts where to move next.

`GoalDrive` decides: pure, without a clock or devices. The estimate may come from any method; without one the
robot rests. A way over experiences, whose poses scatter, is driven in long straight legs, each at one
heading: odometry errs most in turns, and views are those remembered only at the headings at which the way was
driven. `GoalRoute` aims the arm anew by each estimate.
"""

from __future__ import annotations

from enum import Enum
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ratslam.live.goal_planner import RECENT, GoalPlanner
from ratslam.places.contact_alignment import RememberedContacts, placed_points
from ratslam.places.route import NoWay
from robot.drivers.ur10.safety import TargetRefused
from robot.live.arm_route import MovableArm
from robot.live.live_config import GoalConfig, LiveConfig
from tactile.base.se2 import between, compose, line_distances, wrap

CORNER = 0.008
"""Distance from the end of a leg at which the next one begins, m."""
STEADY = 0.2
"""Difference in heading from that of a leg above which the robot turns, rad."""
JOINED = 0.15
"""Length of the beginning of a way in which the robot may join it, m."""
UNSURE = 5
"""Whisks at a goal with a pose that is not sure after which some of the way is driven back."""
RETURNED = 0.4
"""Length of that part, m: enough for about as many keyframes as a lost robot needs to be found."""
NEAR_WAY = 0.3
"""Length of the way ahead that contacts can block, m: more than the reach of the whiskers."""


class DriveState(Enum):
    """What the drive does, or how it ended."""

    DRIVING = "on the way"
    WAITING = "at rest, without an estimate on the map or with a contact on the way"
    REACHED = "at the goal"
    BLOCKED = "no way to the goal is left"
    LOST = "the robot does not know where it is"

    @property
    def ended(self) -> bool:
        return self not in (DriveState.DRIVING, DriveState.WAITING)


class GoalDrive:
    """Drives to one goal after the other.

    Args:
        cell: side of a pose cell, m.

    Attributes:
        state: of the present goal, or the end. reason: of the last change. goal: number of the present goal.
        replans: new ways for it so far. target: [3] pose in the map to move to, None: rest. way: [K, 3] the
            present way. obstacles: [n, 2] contacts found on ways, in the map, m. off_way: largest distance
            from the way, m.
    """

    def __init__(self, config: GoalConfig, planner: GoalPlanner, cell: float) -> None:
        self.state, self.reason = DriveState.WAITING, ""
        self.goal = self.replans = 0
        self.target: np.ndarray | None = None
        self.way: np.ndarray | None = None
        self.obstacles = np.zeros((0, 2))
        self.config, self._planner = config, planner
        self.off_way = config.off_way * cell
        self._missing = self._touched = 0
        self._returning, self._returns, self._unsure = False, 0, 0
        self._legs: list[_Leg] = []  # that are left

    @property
    def finished(self) -> bool:
        """Whether all goals are reached, or one cannot be."""
        last = self.state is DriveState.REACHED and self.goal == len(self.config.to) - 1
        return last or self.state in (DriveState.BLOCKED, DriveState.LOST)

    def next_goal(self) -> None:
        """Turns to the next goal; obstacles stay known."""
        self.goal, self.replans, self.way = self.goal + 1, 0, None
        self._returning, self._returns, self._unsure = False, 0, 0
        self.state, self.target = DriveState.WAITING, None

    def observe(self, pose: np.ndarray | None, points: np.ndarray, sure: bool = True) -> DriveState:
        """Decides after a whisk; `target` is where to move.

        Args:
            pose: [3] in the map (m, m, rad); None without an estimate. points: [n, 2] contacts in the map, m.
            sure: whether the method knows the pose and the contacts agree with the map.
        """
        if self.state.ended:
            return self.state
        self.target = None
        if pose is None:
            return self._wait("no estimate")
        if self.way is None and not self._plan(pose):
            return self.state
        if not self._legs:
            return self._end(pose, sure)
        line = np.array([self._legs[0].start, *(leg.end for leg in self._legs)])
        if line_distances(pose[None, :2], line)[0] > self.off_way:
            self.reason = "the estimate is off the way"
            if not self._replan(pose):
                return self.state
        if self._is_blocked(pose, points):
            if self._touched < self.config.confirm:
                self.state, self.reason = DriveState.WAITING, "a contact on the way"
                return self.state
            self._touched = 0
            if not self._replan(pose):
                return self.state
        self._missing = 0
        return self._advance(pose, sure)

    def refuse(self, pose: np.ndarray) -> DriveState:
        """Takes note that the robot cannot move to the target, seen from its estimate [3]: plans anew."""
        assert self.target is not None
        self.obstacles = np.vstack([self.obstacles, self.target[:2]])
        self.target = None
        self._replan(pose)
        return self.state

    def _wait(self, reason: str) -> DriveState:
        self._missing += 1
        lost = self._missing > self.config.patience
        self.state, self.reason = DriveState.LOST if lost else DriveState.WAITING, reason
        return self.state

    def _replan(self, pose: np.ndarray) -> bool:
        if self.replans == self.config.replans:
            self.state, self.reason = DriveState.BLOCKED, f"{self.replans} new ways were blocked too"
            return False
        self.replans += 1
        return self._plan(pose)

    def _plan(self, pose: np.ndarray) -> bool:
        """Plans a way; whether there is one."""
        try:
            self.way = way = self._planner.plan(pose, self.goal, self.obstacles)
        except NoWay as error:
            self.way, self.state, self.reason = None, DriveState.BLOCKED, str(error)
            return False
        if way is None:
            self._wait(f"no experience within {self.config.farthest:g} m of the estimate")
            return False
        # The way is joined beside its beginning, without the detour over its first poses.
        first, count = 0, int(np.searchsorted(_lengths(way), JOINED, side="right"))
        if count >= 2:
            off = [line_distances(pose[None, :2], way[k : k + 2, :2])[0] for k in range(count - 1)]
            first = int(np.argmin(off)) + 1
        self._legs = legs_of(np.vstack([[*pose[:2], way[first, 2]], way[first:]]))
        return True

    def _end(self, pose: np.ndarray, sure: bool) -> DriveState:
        """At the end of a way: the goal is reached if the pose is sure; otherwise some of the way is driven
        back, to be driven again."""
        assert self.way is not None
        self.target = None
        away = float(np.hypot(*(pose - self.way[-1])[:2]))
        if self._returning or away > self.off_way:
            self._returning, self.way = False, None
            self.state, self.reason = DriveState.WAITING, "on the way again"
        elif sure:
            self.state, self.reason = DriveState.REACHED, ""
        elif self._returns == self.config.returns:
            self.state, self.reason = DriveState.LOST, "the goal's surroundings do not fit the map"
        elif self._unsure < UNSURE:
            self._unsure += 1
            self.state, self.reason = DriveState.WAITING, "the pose is not sure"
        else:
            self._returning, self._unsure, self._returns = True, 0, self._returns + 1
            back = self.way[::-1]
            self._legs = legs_of(back[: max(2, int(np.searchsorted(_lengths(back), RETURNED, side="right")))])
        return self.state

    def _advance(self, pose: np.ndarray, sure: bool) -> DriveState:
        while self._legs and self._legs[0].is_passed(
            pose, CORNER if len(self._legs) > 1 else self.config.tolerance
        ):
            self._legs.pop(0)
        if not self._legs:
            return self._end(pose, sure)
        self.state, self.reason = DriveState.DRIVING, ""
        leg = self._legs[0]
        if abs(wrap(leg.heading - pose[2])) > STEADY:
            self.target = np.array([*pose[:2], leg.heading])
        else:
            self.target = np.array([*leg.end, pose[2]])
        return self.state

    def _is_blocked(self, pose: np.ndarray, points: np.ndarray) -> bool:
        """Whether a contact lies on the way ahead; counts such whisks, and remembers the contacts once
        they are confirmed."""
        # [K, 2] the line from the pose over the ends of the legs that are left, for `NEAR_WAY`.
        line = np.vstack([pose[None, :2], *(leg.end[None] for leg in self._legs)])
        done = _lengths(line)
        count = int(np.searchsorted(done, NEAR_WAY))
        if count < len(line):
            share = (NEAR_WAY - done[count - 1]) / np.hypot(*(line[count] - line[count - 1]))
            line[count] = line[count - 1] + share * (line[count] - line[count - 1])
        near = line_distances(points, line[: count + 1]) < self.config.standoff
        self._touched = self._touched + 1 if near.any() else 0
        if self._touched >= self.config.confirm:
            self.reason = "a contact on the way"
            self.obstacles = np.vstack([self.obstacles, points[near]])
        return bool(near.any())


def _lengths(way: np.ndarray) -> np.ndarray:
    """[K] length of a way [K, 2 or 3] up to each of its poses, m."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way[:, :2], axis=0).T))])


SCATTER = 0.02
"""Largest distance of the poses of a way from its legs, m."""
ALONG = 0.35
"""Largest difference between a heading on a leg and its direction, or the reverse, at which it was driven so,
rad."""


class _Leg(NamedTuple):
    """A straight move at one heading.

    Attributes:
        start, end: [2] m. heading: rad.
    """

    start: np.ndarray
    end: np.ndarray
    heading: float

    def is_passed(self, pose: np.ndarray, tolerance: float) -> bool:
        """Whether a pose [3] is at the end of the leg, within the tolerance (m), or beyond it."""
        step, left = self.end - self.start, self.end - pose[:2]
        return bool(np.hypot(*left) <= tolerance or step @ left < 0)


def legs_of(way: np.ndarray) -> list[_Leg]:
    """The legs of a way [K, 3] (m, m, rad), K >= 1: its poses within `SCATTER` of the legs (Douglas &
    Peucker 1973). A way of one place is one leg without length."""
    if len(way) == 1:
        return [_Leg(way[0, :2], way[0, :2], float(way[0, 2]))]
    marks = _vertices(way[:, :2])
    return [_Leg(way[a, :2], way[b, :2], leg_heading(way[a : b + 1])) for a, b in pairwise(marks)]


def leg_heading(poses: np.ndarray) -> float:
    """The heading of a leg over poses [K, 3]: its direction or the reverse, if at least half of it was driven
    so; otherwise the mean of the headings, each weighted by the length beside it."""
    length = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    weight = np.convolve(length, [0.5, 0.5])
    weight = weight if weight.sum() > 0 else np.ones(len(poses))
    step = poses[-1, :2] - poses[0, :2]
    direction = float(np.arctan2(step[1], step[0]))
    for candidate in (direction, direction + np.pi):
        along = np.abs(wrap(poses[:, 2] - candidate)) <= ALONG
        if np.hypot(*step) > SCATTER and weight[along].sum() >= weight.sum() / 2:
            return float(wrap(candidate))
    return float(np.angle(np.sum(weight * np.exp(1j * poses[:, 2]))))


def _vertices(line: np.ndarray) -> list[int]:
    """Numbers of the points of a line [K, 2] between which it is straight."""
    kept, open_parts = {0, len(line) - 1}, [(0, len(line) - 1)]
    while open_parts:
        a, b = open_parts.pop()
        if b - a < 2:
            continue
        off = line_distances(line[a + 1 : b], line[[a, b]])
        far = int(np.argmax(off))
        if off[far] > SCATTER:
            middle = a + 1 + far
            kept.add(middle)
            open_parts += [(a, middle), (middle, b)]
    return sorted(kept)


GAIN = 0.1
"""Least share of the difference between estimate and expected pose that a whisk takes up."""
OUTLIER = np.array([0.03, 0.03, 0.1])
"""Largest difference (m, m, rad) that is taken up; what exceeds it is an outlier (Huber 1964). Odometry with
the errors of a mobile robot is wrong by up to 0.6 rad after a turn, until recall corrects it."""
SETTLED = 5
"""Whisks after which differences are limited so."""
MOVED = 5
"""Consecutive whisks elsewhere after which the robot has been moved."""
NEW = 0.04
"""Distance from an obstacle within which contacts are its own, m."""
SAME, SAME_TURN = 0.005, 0.03
"""Change of the target below which the present move goes on, m and rad."""


class GoalRoute:
    """Moves the arm as a drive decides; without a target it halts the arm.

    The map and the arm have frames of their own. The arm's own motion is far more accurate than one estimate:
    the pose to steer by moves with the arm and takes up a share of its difference to each estimate: 1 / n in
    the n-th whisk, which is the mean of all, and at least `GAIN`. A difference of more than `off_way` (m) in
    `MOVED` whisks is taken up at once: the robot is elsewhere; but contacts that agree with the map at the
    pose and not at the estimate deny it. Without estimates the arm's motion alone leads
    on for `coast` (m), as long as the contacts of the last whisks agree with the map; then the head rests. A
    pose is sure if the estimate is within `off_way` of it and the contacts agree.

    Args:
        contacts: those of the map, with which the last ones are aligned; recall does not do so.

    Attributes:
        drive: what decides. pose: [3] in the map to steer by; None before the first estimate.
    """

    def __init__(self, drive: GoalDrive, config: LiveConfig, contacts: RememberedContacts) -> None:
        self.drive = drive
        self.pose: np.ndarray | None = None
        self._placing, self._speed, self._contacts = config.arm.placing, config.route_speed, contacts
        self._recent: list[tuple[np.ndarray, np.ndarray]] = []  # arm's pose and contacts of the last whisks
        self._unseen = 0.0  # way without an estimate, m
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
        poses, felt = zip(*self._recent, strict=True)  # the last contacts, as seen from the arm's pose now
        recent = placed_points(np.array([between(arm_pose, before) for before in poses]), felt)
        if estimate is not None and not self._correct(estimate, recent):
            estimate = None
        sure = self.pose is not None and self._align(estimate, recent)
        if self.pose is None or (estimate is None and self._unseen > self.drive.config.coast):
            self.pose = None
            return self.rest()
        now = compose(self.pose, between(arm_pose, arm_now))
        state = self.drive.observe(now, placed_points(self.pose[None], [points]), sure)
        if self.drive.target is not None:
            self._target = compose(arm_now, between(now, self.drive.target))
        return state

    def rest(self) -> DriveState:
        """A whisk stays without any result: the arm rests."""
        self._target = None
        return self.drive.observe(None, np.zeros((0, 2)))

    def _align(self, estimate: np.ndarray | None, points: np.ndarray) -> bool:
        """Aligns the last contacts [n, 2] with those of the map; returns whether the pose is sure then."""
        assert self.pose is not None
        self.pose = self._contacts.align(self.pose, points)
        # The map does not have the obstacles that were found on the way.
        found = self.drive.obstacles
        away = np.linalg.norm(placed_points(self.pose[None], [points])[:, None] - found, axis=-1)
        agrees = self._contacts.agrees(self.pose, points[(away > NEW).all(axis=1)])
        if estimate is None:
            self._unseen = self._unseen if agrees else np.inf
            return False
        return agrees and bool(np.hypot(*(self.pose - estimate)[:2]) <= self.drive.off_way)

    def _correct(self, estimate: np.ndarray, points: np.ndarray) -> bool:
        """Moves the pose towards the estimate, unless only the pose as it is agrees with the last contacts
        [n, 2] in base_link, m; returns whether it did."""
        apart = np.zeros(3) if self.pose is None else between(self.pose, estimate)
        self._elsewhere = self._elsewhere + 1 if np.hypot(apart[0], apart[1]) > self.drive.off_way else 0
        if self.pose is not None and self._elsewhere:
            here, there = (self._contacts.align(pose, points) for pose in (self.pose, estimate))
            if self._contacts.agrees(here, points) and not self._contacts.agrees(there, points):
                return False
        self._unseen, self._count = 0.0, self._count + 1
        if self.pose is None or self._elsewhere >= MOVED:
            self.pose, self._count, self._elsewhere = estimate, 1, 0
            return True
        share = max(GAIN, 1 / self._count)
        most = OUTLIER if self._count > SETTLED else np.full(3, np.inf)
        self.pose = compose(self.pose, share * np.clip(apart, -most, most))
        return True

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
        sent, target = self._sent, self._target
        if (
            sent is None
            or np.hypot(*(sent[:2] - target[:2])) > SAME
            or abs(wrap(sent[2] - target[2])) > SAME_TURN
        ):
            try:
                arm.move(self._placing.tcp_from_pose(self._target), self._speed)
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
