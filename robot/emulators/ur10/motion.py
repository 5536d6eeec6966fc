"""Motions as values: `advance` gives the arm's state after a time step and the rest of the motion.

Orders to the arm (straight move, stop), their motions, and the parsing of moves in URScript text.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from robot.emulators.ur10 import kinematics
from robot.emulators.ur10.kinematics import Vector6, compose_poses, invert_pose, rotate_by, rotation_between

ZERO: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class Unreachable(ValueError):
    """No joint solution for a pose."""


class MotionState(NamedTuple):
    """State of the arm.

    Attributes:
        tcp: [6] tool pose in the base frame, m and rotation vector rad. speed: [6] tool speed, m/s and rad/s.
        joints: [6] rad. joint_speed: [6] rad/s.
    """

    tcp: Vector6
    speed: Vector6
    joints: Vector6
    joint_speed: Vector6


class ArmModel(NamedTuple):
    """The arm's lengths, and the tool's pose in the flange with its inverse."""

    geometry: kinematics.Geometry
    tool: Vector6 = ZERO
    tool_back: Vector6 = ZERO

    def with_tool(self, tool: Vector6) -> ArmModel:
        return ArmModel(self.geometry, tool, invert_pose(tool))

    def forward(self, joints: Sequence[float]) -> Vector6:
        return compose_poses(kinematics.forward(self.geometry, joints), self.tool)

    def backward(self, tcp: Sequence[float], near: Sequence[float]) -> Vector6:
        joints = kinematics.backward(self.geometry, compose_poses(tcp, self.tool_back), near)
        if joints is None:
            raise Unreachable(f"no joints for {[round(number, 4) for number in tcp]}")
        return joints


class Profile(NamedTuple):
    """Trapezoidal speed profile from rest to rest over a length (m or rad)."""

    length: float
    speed: float
    acceleration: float

    @property
    def ramp(self) -> float:
        """Duration of acceleration, and of deceleration, s."""
        return min(self.speed / self.acceleration, math.sqrt(self.length / self.acceleration))

    @property
    def duration(self) -> float:
        """Duration, s."""
        ramp = self.ramp
        return ramp + self.length / (ramp * self.acceleration) if self.length > 0 else 0.0

    def at(self, time: float) -> tuple[float, float]:
        """Covered length and speed at a time, s."""
        ramp, duration = self.ramp, self.duration
        if time >= duration:
            return self.length, 0.0
        top = ramp * self.acceleration
        if time < ramp:
            return self.acceleration * time * time / 2, self.acceleration * time
        if time < duration - ramp:
            return top * (time - ramp / 2), top
        left = duration - time
        return self.length - self.acceleration * left * left / 2, self.acceleration * left


class LinearMotion(NamedTuple):
    """A straight move of the tool to a pose; its rotation is proportional to the distance."""

    start: Vector6
    way: Vector6  # translation m and rotation vector rad, in the base frame
    profile: Profile
    time: float = 0.0

    def advance(
        self, model: ArmModel, state: MotionState, dt: float
    ) -> tuple[MotionState, LinearMotion | None]:
        time = self.time + dt
        done, rate = self.profile.at(time)
        length = self.profile.length or 1.0
        x, y, z, rx, ry, rz = (done / length * number for number in self.way)
        start = self.start
        tcp = (start[0] + x, start[1] + y, start[2] + z, *rotate_by(start, (rx, ry, rz)))
        speed = scale(self.way, rate / length)
        after = tool_state(model, state, tcp, speed, dt)
        return after, None if time >= self.profile.duration else self._replace(time=time)


class ToolSpeedMotion(NamedTuple):
    """Accelerates to a tool speed and keeps it; ends at speed 0."""

    goal: Vector6
    acceleration: float
    turn_ratio: float

    def advance(
        self, model: ArmModel, state: MotionState, dt: float
    ) -> tuple[MotionState, ToolSpeedMotion | None]:
        step = self.acceleration * dt
        linear = step_towards(state.speed[:3], self.goal[:3], step)
        angular = step_towards(state.speed[3:], self.goal[3:], step * self.turn_ratio)
        x, y, z = linear
        rx, ry, rz = angular
        tcp = (
            state.tcp[0] + x * dt,
            state.tcp[1] + y * dt,
            state.tcp[2] + z * dt,
            *rotate_by(state.tcp, (rx * dt, ry * dt, rz * dt)),
        )
        speed = (x, y, z, rx, ry, rz)
        after = tool_state(model, state, tcp, speed, dt)
        return after, None if not any(speed) and not any(self.goal) else self


Motion = LinearMotion | ToolSpeedMotion


def linear_motion(
    state: MotionState, goal: Vector6, speed: float, acceleration: float, turn_ratio: float
) -> LinearMotion:
    """The straight motion to `goal`; the slower of translation and rotation sets its duration."""
    x, y, z = (g - s for g, s in zip(goal[:3], state.tcp[:3], strict=True))
    way = (x, y, z, *rotation_between(state.tcp, goal))
    distance, angle = math.hypot(*way[:3]), math.hypot(*way[3:])
    straight = Profile(distance, speed, acceleration)
    turning = Profile(angle, speed * turn_ratio, acceleration * turn_ratio)
    return LinearMotion(state.tcp, way, max(straight, turning, key=lambda profile: profile.duration))


def tool_state(model: ArmModel, state: MotionState, tcp: Vector6, speed: Vector6, dt: float) -> MotionState:
    """The arm's state `dt` s later, with the tool at `tcp`. Raises `Unreachable`."""
    joints = model.backward(tcp, state.joints)
    return MotionState(tcp, speed, joints, scale(subtract(joints, state.joints), 1 / dt))


def step_towards(now: Sequence[float], goal: Sequence[float], step: float) -> tuple[float, ...]:
    """The vector `now` moved towards `goal` by at most `step`."""
    way = [g - n for g, n in zip(goal, now, strict=True)]
    length = math.hypot(*way)
    if length <= step:
        return tuple(goal)
    return tuple(n + w * step / length for n, w in zip(now, way, strict=True))


def subtract(first: Vector6, second: Vector6) -> Vector6:
    a, b, c, d, e, f = (x - y for x, y in zip(first, second, strict=True))
    return a, b, c, d, e, f


def scale(vector: Vector6, scale: float) -> Vector6:
    a, b, c, d, e, f = (x * scale for x in vector)
    return a, b, c, d, e, f


SMALL = 1e-9  # least speed and acceleration; the client accepts 0, at which a move never ends


class MoveL(NamedTuple):
    """A straight move to a tool pose, with speed in m/s and acceleration in m/s^2."""

    goal: Vector6
    speed: float
    acceleration: float


class StopL(NamedTuple):
    """A stop of the tool, with deceleration in m/s^2."""

    acceleration: float


MoveOrder = MoveL | StopL


def start_motion(order: MoveOrder, model: ArmModel, state: MotionState, turn_ratio: float) -> Motion | None:
    """The motion that executes an order; None if the tool is at the goal already.

    Raises:
        Unreachable: no joint solution for the goal.
    """
    if isinstance(order, StopL):
        return ToolSpeedMotion(ZERO, max(order.acceleration, SMALL), turn_ratio)
    model.backward(order.goal, state.joints)
    limits = max(order.speed, SMALL), max(order.acceleration, SMALL)
    way: LinearMotion = linear_motion(state, order.goal, *limits, turn_ratio)
    return way if way.profile.length > 0 else None


_MOVE = re.compile(r"^\s*movel\(p\[(?P<pose>[^]]*)\](?P<limits>[^)]*)\)\s*$")
_LIMIT = re.compile(r"\b([av])\s*=\s*([-+.\deE]+)")


def parse_moves(text: str) -> list[MoveL]:
    """The lines `movel(p[...], a=..., v=...)` of URScript text; all other lines are ignored."""
    moves = []
    for match in filter(None, map(_MOVE.match, text.splitlines())):
        with contextlib.suppress(ValueError):  # not numbers: the line is ignored
            x, y, z, rx, ry, rz = map(float, match["pose"].split(","))
            limits = {"a": 1.2, "v": 0.25} | {
                name: float(value) for name, value in _LIMIT.findall(match["limits"])
            }
            moves.append(MoveL((x, y, z, rx, ry, rz), limits["v"], limits["a"]))
    return moves
