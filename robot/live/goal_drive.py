"""Driving to goals on a map, whisk by whisk: decides from estimates and contacts where to move next.

Pure: no clock, no devices. The estimate may come from any method; without one the robot rests.

Straight legs of a way: what a robot drives that turns on the spot and then moves without turning.

Odometry errs most in turns, and views are those remembered only at the headings at which the way was driven.
So a way over experiences, whose poses scatter, is driven in long straight legs, each at one heading.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from itertools import pairwise
from typing import NamedTuple, Protocol

import numpy as np

from robot.live.goal_config import GoalConfig
from tactile.base.se2 import compose, wrap
from tactile.base.segments import line_distances

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


class Sighting(NamedTuple):
    """What is known after a whisk.

    Attributes:
        pose: [3] in the map (m, m, rad); None without an estimate. points: [n, 2] contacts in the map, m.
            sure: whether the method knows the pose and the contacts agree with the map.
    """

    pose: np.ndarray | None
    points: np.ndarray
    sure: bool = True


class PlannedWay(NamedTuple):
    """The answer of a planner: poses [K, 3] in the map, or None with the state and the reason."""

    poses: np.ndarray | None
    state: DriveState = DriveState.DRIVING
    reason: str = ""


class Planner(Protocol):
    """Plans ways over driven ground."""

    def plan(self, pose: np.ndarray, goal: int, obstacles: np.ndarray) -> PlannedWay:
        """The way from a pose [3] to a goal (its number in the list), clear of obstacles [n, 2] m.

        `DriveState.BLOCKED`: there is none. `DriveState.LOST`: the pose is away from driven ground.
        """
        ...


class GoalDrive:
    """Drives to one goal after the other.

    Args:
        cell: side of a pose cell, m. count: number of goals.

    Attributes:
        state: of the present goal, or the end. reason: of the last change. goal: number of the present goal.
        replans: new ways for it so far. target: [3] pose in the map to move to, None: rest. way: [K, 3] the
            present way. obstacles: [n, 2] contacts found on ways, in the map, m. off_way: largest distance
            from the way, m.
    """

    def __init__(self, config: GoalConfig, planner: Planner, cell: float, count: int) -> None:
        self.state, self.reason = DriveState.WAITING, ""
        self.goal = self.replans = 0
        self.target: np.ndarray | None = None
        self.way: np.ndarray | None = None
        self.obstacles = np.zeros((0, 2))
        self._config, self._planner, self._count = config, planner, count
        self.off_way = config.off_way * cell
        self._missing = self._touched = 0
        self._returning, self._returns, self._unsure = False, 0, 0
        self._legs: list[Leg] = []  # that are left

    @property
    def finished(self) -> bool:
        """Whether all goals are reached, or one cannot be."""
        last = self.goal == self._count - 1
        return self.state in (DriveState.BLOCKED, DriveState.LOST) or (
            self.state is DriveState.REACHED and last
        )

    def next_goal(self) -> None:
        """Turns to the next goal; obstacles stay known."""
        self.goal, self.replans, self.way = self.goal + 1, 0, None
        self._returning, self._returns, self._unsure = False, 0, 0
        self.state, self.target = DriveState.WAITING, None

    def observe(self, sighting: Sighting) -> DriveState:
        """Decides after a whisk; `target` is where to move."""
        if self.state.ended:
            return self.state
        self.target = None
        if sighting.pose is None:
            return self._wait("no estimate")
        if self.way is None and not self._plan(sighting.pose):
            return self.state
        if not self._legs:
            return self._end(sighting)
        if self._distance_to_way(sighting.pose) > self.off_way:
            self.reason = "the estimate is off the way"
            if not self._replan(sighting.pose):
                return self.state
        if self._is_blocked(sighting):
            if self._touched < self._config.confirm:
                self.state, self.reason = DriveState.WAITING, "a contact on the way"
                return self.state
            self._touched = 0
            if not self._replan(sighting.pose):
                return self.state
        self._missing = 0
        return self._advance(sighting)

    def refuse(self, pose: np.ndarray) -> DriveState:
        """Takes note that the robot cannot move to the target, seen from its estimate [3]: plans anew."""
        assert self.target is not None
        self.obstacles = np.vstack([self.obstacles, self.target[:2]])
        self.target = None
        self._replan(pose)
        return self.state

    def _wait(self, reason: str) -> DriveState:
        self._missing += 1
        lost = self._missing > self._config.patience
        self.state, self.reason = DriveState.LOST if lost else DriveState.WAITING, reason
        return self.state

    def _replan(self, pose: np.ndarray) -> bool:
        if self.replans == self._config.replans:
            self.state, self.reason = DriveState.BLOCKED, f"{self.replans} new ways were blocked too"
            return False
        self.replans += 1
        return self._plan(pose)

    def _plan(self, pose: np.ndarray) -> bool:
        """Plans a way; whether there is one."""
        made = self._planner.plan(pose, self.goal, self.obstacles)
        self.way = made.poses
        if made.poses is not None:
            self._legs = legs_of(join_way(made.poses, pose))
            return True
        if made.state is DriveState.LOST:
            self._wait(made.reason)
        else:
            self.state, self.reason = made.state, made.reason
        return False

    def _end(self, sighting: Sighting) -> DriveState:
        """At the end of a way: the goal is reached if the pose is sure; otherwise some of the way is driven
        back, to be driven again."""
        assert self.way is not None
        assert sighting.pose is not None
        self.target = None
        away = float(np.hypot(*(sighting.pose - self.way[-1])[:2]))
        if self._returning or away > self.off_way:
            self._returning, self.way = False, None
            self.state, self.reason = DriveState.WAITING, "on the way again"
        elif sighting.sure:
            self.state, self.reason = DriveState.REACHED, ""
        elif self._returns == self._config.returns:
            self.state, self.reason = DriveState.LOST, "the goal's surroundings do not fit the map"
        elif self._unsure < UNSURE:
            self._unsure += 1
            self.state, self.reason = DriveState.WAITING, "the pose is not sure"
        else:
            self._returning, self._unsure, self._returns = True, 0, self._returns + 1
            self._legs = legs_of(beginning(self.way[::-1], RETURNED))
        return self.state

    def _advance(self, sighting: Sighting) -> DriveState:
        assert sighting.pose is not None
        pose = sighting.pose
        while self._legs and is_passed(
            self._legs[0], pose, CORNER if len(self._legs) > 1 else self._config.tolerance
        ):
            self._legs.pop(0)
        if not self._legs:
            return self._end(sighting)
        self.state, self.reason = DriveState.DRIVING, ""
        leg = self._legs[0]
        if abs(wrap(leg.heading - pose[2])) > STEADY:
            self.target = np.array([*pose[:2], leg.heading])
        else:
            self.target = np.array([*leg.end, pose[2]])
        return self.state

    def _is_blocked(self, sighting: Sighting) -> bool:
        """Whether a contact lies on the way ahead; counts such whisks, and remembers the contacts once
        they are confirmed."""
        assert self.way is not None
        assert sighting.pose is not None
        points = sighting.points
        near = line_distances(points, line_ahead(self._legs, sighting.pose)) < self._config.standoff
        self._touched = self._touched + 1 if near.any() else 0
        if self._touched >= self._config.confirm:
            self.reason = "a contact on the way"
            self.obstacles = np.vstack([self.obstacles, points[near]])
        return bool(near.any())

    def _distance_to_way(self, pose: np.ndarray) -> float:
        line = [self._legs[0].start, *(leg.end for leg in self._legs)]
        return float(line_distances(pose[None, :2], np.array(line))[0])


def is_passed(leg: Leg, pose: np.ndarray, tolerance: float) -> bool:
    """Whether a pose is at the end of a leg, within the tolerance (m), or beyond it."""
    step, left = leg.end - leg.start, leg.end - pose[:2]
    return bool(np.hypot(*left) <= tolerance or step @ left < 0)


def join_way(way: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """The way [K, 3] from a pose [3] beside its beginning on, without the detour over its first poses."""
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way[:, :2], axis=0).T))])
    count = int(np.searchsorted(far, JOINED, side="right"))
    if count < 2:
        return np.vstack([[*pose[:2], way[0, 2]], way])
    off = [line_distances(pose[None, :2], way[k : k + 2, :2])[0] for k in range(count - 1)]
    first = int(np.argmin(off)) + 1
    return np.vstack([[*pose[:2], way[first, 2]], way[first:]])


def beginning(way: np.ndarray, length: float) -> np.ndarray:
    """The first poses of a way [K, 3], up to a length (m); at least two, if there are."""
    far = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way[:, :2], axis=0).T))])
    return way[: max(2, int(np.searchsorted(far, length, side="right")))]


def points_in_map(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[n, 2] points in base_link, seen from a pose [3] in the map."""
    points = np.asarray(points, float).reshape(-1, 2)
    return compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]


def line_ahead(legs: Sequence[Leg], pose: np.ndarray) -> np.ndarray:
    """[K, 2] the line from a pose over the ends of these legs, for `NEAR_WAY`."""
    line = np.vstack([pose[None, :2], *(leg.end[None] for leg in legs)])
    length = np.hypot(*np.diff(line, axis=0).T)
    done = np.concatenate([[0.0], np.cumsum(length)])
    count = int(np.searchsorted(done, NEAR_WAY))
    if count < len(line):
        share = (NEAR_WAY - done[count - 1]) / length[count - 1]
        line[count] = line[count - 1] + share * (line[count] - line[count - 1])
    return line[: count + 1]


SCATTER = 0.02
"""Largest distance of the poses of a way from its legs, m."""
ALONG = 0.35
"""Largest difference between a heading on a leg and its direction, or the reverse, at which it was driven so,
rad."""


class Leg(NamedTuple):
    """A straight move at one heading.

    Attributes:
        start, end: [2] m. heading: rad.
    """

    start: np.ndarray
    end: np.ndarray
    heading: float


def legs_of(way: np.ndarray) -> list[Leg]:
    """The legs of a way [K, 3] (m, m, rad), K >= 1: its poses within `SCATTER` of the legs (Douglas &
    Peucker 1973). A way of one place is one leg without length."""
    if len(way) == 1:
        return [Leg(way[0, :2], way[0, :2], float(way[0, 2]))]
    marks = _vertices(way[:, :2])
    return [Leg(way[a, :2], way[b, :2], leg_heading(way[a : b + 1])) for a, b in pairwise(marks)]


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
