"""Motions as values: each says what the arm's state is a time step later, and whether it goes on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from robot.emulators.ur10 import kinematics
from robot.emulators.ur10.rotation import Vector6, composed, inverse, turn, turned

ZERO: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
JOINT_SPEED = 2.0944  # rad/s: 120 degrees a second, what a UR10's shoulder and base can do (data sheet)


class Unreachable(ValueError):
    """The controller finds no joints for a pose."""


class State(NamedTuple):
    """Where the arm is.

    Attributes:
        tcp: the tool's pose in the base. speed: its speed there, m/s, rad/s. joints: rad. joint_speed: rad/s.
    """

    tcp: Vector6
    speed: Vector6
    joints: Vector6
    joint_speed: Vector6


class Model(NamedTuple):
    """The arm's lengths, and the tool's pose in the flange with its inverse."""

    geometry: kinematics.Geometry
    tool: Vector6 = ZERO
    tool_back: Vector6 = ZERO

    def with_tool(self, tool: Vector6) -> Model:
        return Model(self.geometry, tool, inverse(tool))

    def forward(self, joints: Sequence[float]) -> Vector6:
        return composed(kinematics.forward(self.geometry, joints), self.tool)

    def backward(self, tcp: Sequence[float], near: Sequence[float]) -> Vector6:
        joints = kinematics.backward(self.geometry, composed(tcp, self.tool_back), near)
        if joints is None:
            raise Unreachable(f"no joints for {[round(number, 4) for number in tcp]}")
        return joints


class Profile(NamedTuple):
    """From rest to rest over a length (m or rad) at no more than a speed: a trapezoid of speed over time."""

    length: float
    speed: float
    acceleration: float

    @property
    def ramp(self) -> float:
        """s of speeding up, and of slowing down."""
        return min(self.speed / self.acceleration, math.sqrt(self.length / self.acceleration))

    @property
    def duration(self) -> float:
        """s"""
        ramp = self.ramp
        return ramp + self.length / (ramp * self.acceleration) if self.length > 0 else 0.0

    def at(self, time: float) -> tuple[float, float]:
        """(length done, speed) at a time."""
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


class Line(NamedTuple):
    """Straight to a pose, turning evenly with the way."""

    start: Vector6
    way: Vector6  # m in the base, and rotation vector in the base
    profile: Profile
    time: float = 0.0

    def advanced(self, model: Model, state: State, dt: float) -> tuple[State, Line | None]:
        time = self.time + dt
        done, rate = self.profile.at(time)
        length = self.profile.length or 1.0
        x, y, z, rx, ry, rz = (done / length * number for number in self.way)
        start = self.start
        tcp = (start[0] + x, start[1] + y, start[2] + z, *turned(start, (rx, ry, rz)))
        speed = scaled(self.way, rate / length)
        after = by_tool(model, state, tcp, speed, dt)
        return after, None if time >= self.profile.duration else self._replace(time=time)


class Swing(NamedTuple):
    """To joints, all arriving together."""

    start: Vector6
    way: Vector6  # rad
    profile: Profile
    time: float = 0.0

    def advanced(self, model: Model, state: State, dt: float) -> tuple[State, Swing | None]:
        time = self.time + dt
        done, rate = self.profile.at(time)
        length = self.profile.length or 1.0
        joints = added(self.start, scaled(self.way, done / length))
        after = by_joints(model, state, joints, scaled(self.way, rate / length), dt)
        return after, None if time >= self.profile.duration else self._replace(time=time)


class Drive(NamedTuple):
    """Towards a speed of the tool and on at it; where that speed is none, until the arm stands."""

    goal: Vector6
    acceleration: float
    turn_ratio: float

    def advanced(self, model: Model, state: State, dt: float) -> tuple[State, Drive | None]:
        step = self.acceleration * dt
        linear = towards(state.speed[:3], self.goal[:3], step)
        angular = towards(state.speed[3:], self.goal[3:], step * self.turn_ratio)
        x, y, z = linear
        rx, ry, rz = angular
        tcp = (
            state.tcp[0] + x * dt,
            state.tcp[1] + y * dt,
            state.tcp[2] + z * dt,
            *turned(state.tcp, (rx * dt, ry * dt, rz * dt)),
        )
        speed = (x, y, z, rx, ry, rz)
        after = by_tool(model, state, tcp, speed, dt)
        return after, None if not any(speed) and not any(self.goal) else self


class Spin(NamedTuple):
    """Towards joint speeds and on at them; where they are none, until the arm stands."""

    goal: Vector6
    acceleration: float

    def advanced(self, model: Model, state: State, dt: float) -> tuple[State, Spin | None]:
        gap = max(abs(g - r) for g, r in zip(self.goal, state.joint_speed, strict=True))
        share = min(1.0, self.acceleration * dt / gap) if gap > 0 else 1.0
        rate = added(state.joint_speed, scaled(difference(self.goal, state.joint_speed), share))
        after = by_joints(model, state, added(state.joints, scaled(rate, dt)), rate, dt)
        return after, None if not any(rate) and not any(self.goal) else self


class Follow(NamedTuple):
    """After joints that are told again and again, lagging by a time."""

    goal: Vector6
    lag: float

    def advanced(self, model: Model, state: State, dt: float) -> tuple[State, Follow | None]:
        share = 1 - math.exp(-dt / self.lag)
        way = scaled(difference(self.goal, state.joints), share)
        most = max(map(abs, way))
        if most > JOINT_SPEED * dt:
            way = scaled(way, JOINT_SPEED * dt / most)
        return by_joints(model, state, added(state.joints, way), scaled(way, 1 / dt), dt), self


Motion = Line | Swing | Drive | Spin | Follow


def line(state: State, goal: Vector6, speed: float, acceleration: float, turn_ratio: float) -> Line:
    """The way and the turn each get the time they need; the longer one is kept by both."""
    x, y, z = (g - s for g, s in zip(goal[:3], state.tcp[:3], strict=True))
    way = (x, y, z, *turn(state.tcp, goal))
    distance, angle = math.hypot(*way[:3]), math.hypot(*way[3:])
    straight = Profile(distance, speed, acceleration)
    turning = Profile(angle, speed * turn_ratio, acceleration * turn_ratio)
    return Line(state.tcp, way, max(straight, turning, key=lambda profile: profile.duration))


def swing(state: State, goal: Vector6, speed: float, acceleration: float) -> Swing:
    """The joint with the longest way sets the time."""
    way = difference(goal, state.joints)
    return Swing(state.joints, way, Profile(max(map(abs, way)), speed, acceleration))


def by_tool(model: Model, state: State, tcp: Vector6, speed: Vector6, dt: float) -> State:
    """The state after the tool was led to a pose."""
    joints = model.backward(tcp, state.joints)
    return State(tcp, speed, joints, scaled(difference(joints, state.joints), 1 / dt))


def by_joints(model: Model, state: State, joints: Vector6, rate: Vector6, dt: float) -> State:
    """The state after the joints were led."""
    tcp = model.forward(joints)
    if not any(rate):
        return State(tcp, ZERO, joints, rate)
    way = (*difference(tcp, state.tcp)[:3], *turn(state.tcp, tcp))
    return State(tcp, scaled(way, 1 / dt), joints, rate)


def towards(now: Sequence[float], goal: Sequence[float], step: float) -> tuple[float, ...]:
    """A vector moved at most a step towards another."""
    way = [g - n for g, n in zip(goal, now, strict=True)]
    length = math.hypot(*way)
    if length <= step:
        return tuple(goal)
    return tuple(n + w * step / length for n, w in zip(now, way, strict=True))


def added(first: Vector6, second: Vector6) -> Vector6:
    a, b, c, d, e, f = (x + y for x, y in zip(first, second, strict=True))
    return a, b, c, d, e, f


def difference(first: Vector6, second: Vector6) -> Vector6:
    a, b, c, d, e, f = (x - y for x, y in zip(first, second, strict=True))
    return a, b, c, d, e, f


def scaled(vector: Vector6, scale: float) -> Vector6:
    a, b, c, d, e, f = (x * scale for x in vector)
    return a, b, c, d, e, f
