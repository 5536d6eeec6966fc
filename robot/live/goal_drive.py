"""Driving to goals on a map, whisk by whisk: decides from estimates and contacts where to move next.

Pure: no clock, no devices. The estimate may come from any method; without one the robot rests.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np

from robot.live.goal_config import GoalConfig
from tactile.base.se2 import compose, wrap
from tactile.base.segments import line_distances

DEVIATION, TURN_DEVIATION = 0.012, 0.3
"""Largest deviation of a straight move from the way that it stands for, m and rad."""
LONGEST_TURN = 2.5
"""Largest turn of one move, rad: above half a turn its direction would be ambiguous."""
TURN_LENGTH = 0.05
"""Distance that a turn of 1 rad counts for along a way, m."""
ALIGNED = 0.15
"""Difference in heading at which a pose of the way is passed, rad."""
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
        pose: [3] estimate in the map (m, m, rad); None without one. points: [n, 2] contacts in base_link, m.
    """

    pose: np.ndarray | None
    points: np.ndarray


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
            present way. obstacles: [n, 2] contacts found on ways, in the map, m.
    """

    def __init__(self, config: GoalConfig, planner: Planner, cell: float, count: int) -> None:
        self.state, self.reason = DriveState.WAITING, ""
        self.goal = self.replans = 0
        self.target: np.ndarray | None = None
        self.way: np.ndarray | None = None
        self.obstacles = np.zeros((0, 2))
        self._config, self._planner, self._count = config, planner, count
        self._off_way = config.off_way * cell
        self._next = self._aim = self._missing = self._touched = 0

    @property
    def finished(self) -> bool:
        """Whether all goals are reached, or one cannot be."""
        last = self.goal == self._count - 1
        return self.state in (DriveState.BLOCKED, DriveState.LOST) or self.state is DriveState.REACHED and last

    def next_goal(self) -> None:
        """Turns to the next goal; obstacles stay known."""
        self.goal, self.replans, self.way = self.goal + 1, 0, None
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
        if self._distance_to_way(sighting.pose) > self._off_way:
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
        return self._advance(sighting.pose)

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
        self.way, self._next = made.poses, 0
        if made.poses is not None:
            self._aim = min(1, len(made.poses) - 1)
            return True
        if made.state is DriveState.LOST:
            self._wait(made.reason)
        else:
            self.state, self.reason = made.state, made.reason
        return False

    def _advance(self, pose: np.ndarray) -> DriveState:
        way = self.way
        assert way is not None
        self._next = passed_poses(way, pose, self._next, self._aim, self._config.tolerance)
        if self._next == len(way):
            self.state, self.reason = DriveState.REACHED, ""
            return self.state
        self.state, self.reason = DriveState.DRIVING, ""
        self._aim = farthest_straight(way, pose, self._next)
        self.target = way[self._aim]
        return self.state

    def _is_blocked(self, sighting: Sighting) -> bool:
        """Whether a contact lies on the way ahead; counts such whisks, and remembers the contacts once
        they are confirmed."""
        assert self.way is not None
        assert sighting.pose is not None
        points = points_in_map(sighting.pose, sighting.points)
        line = way_ahead(self.way, sighting.pose, self._next)
        near = line_distances(points, line) < self._config.standoff
        self._touched = self._touched + 1 if near.any() else 0
        if self._touched >= self._config.confirm:
            self.reason = "a contact on the way"
            self.obstacles = np.vstack([self.obstacles, points[near]])
        return bool(near.any())

    def _distance_to_way(self, pose: np.ndarray) -> float:
        assert self.way is not None
        return float(line_distances(pose[None, :2], self.way[max(self._next - 1, 0) :, :2])[0])


def passed_poses(way: np.ndarray, pose: np.ndarray, start: int, aim: int, tolerance: float) -> int:
    """Number of poses of the way [K, 3] that are passed, of which `start` were passed before.

    Args:
        aim: the pose that the robot moves to; later ones are not passed yet. tolerance: distance at which a
            pose is passed, m; it must be `ALIGNED` too, except for the last one.
    """
    scale = np.array([1.0, 1.0, TURN_LENGTH])
    off = scale * _apart(way[start : aim + 1], pose)
    k = start + int(np.argmin(np.linalg.norm(off, axis=1)))
    if k < aim and np.dot(scale * _apart(way[k + 1], way[k]), off[k - start]) < 0:
        k += 1  # the robot is between the two
    apart = _apart(way[k], pose)
    near = np.hypot(apart[0], apart[1]) <= tolerance
    return k + bool(near and (k == len(way) - 1 or abs(apart[2]) <= ALIGNED))


def farthest_straight(way: np.ndarray, pose: np.ndarray, start: int) -> int:
    """The farthest pose of the way from `start` on that a straight move from a pose reaches without leaving
    the poses between by more than `DEVIATION` and `TURN_DEVIATION`."""
    share = np.linspace(0.0, 1.0, 65)[:, None, None]
    best = start
    for end in range(start + 1, len(way)):
        step = _apart(way[end], pose)
        if abs(step[2]) > LONGEST_TURN:
            break
        off = _apart(way[start:end], pose + share * step)
        near = np.hypot(off[..., 0], off[..., 1]) <= DEVIATION
        near &= np.abs(off[..., 2]) <= TURN_DEVIATION
        if not near.any(axis=0).all():
            break
        best = end
    return best


def points_in_map(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """[n, 2] points in base_link, seen from a pose [3] in the map."""
    points = np.asarray(points, float).reshape(-1, 2)
    return compose(pose, np.column_stack([points, np.zeros(len(points))]))[:, :2]


def way_ahead(way: np.ndarray, pose: np.ndarray, start: int) -> np.ndarray:
    """[K, 2] the line from a pose over the poses of the way from `start` on, for `NEAR_WAY`."""
    line = np.vstack([pose[None, :2], way[start:, :2]])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    return line[: max(int(np.searchsorted(length, NEAR_WAY)) + 1, 2)]


def _apart(poses: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """[..., 3] differences of poses to a pose, headings wrapped."""
    apart = poses - pose
    apart[..., 2] = wrap(apart[..., 2])
    return apart
