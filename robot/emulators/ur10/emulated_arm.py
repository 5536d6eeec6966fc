"""The emulated arm: straight moves and stops as motions in control steps, and walls that push its tool.

A motion is a value: its `advance` gives the tool's pose and speed after a time step, and the rest of the
motion. Moves are also read from URScript text.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from robot.emulators.ur10.emulator_config import PokedWallsConfig, UrEmulatorConfig
from robot.emulators.ur10.kinematics import (
    UR10,
    UR10E,
    Vector6,
    compose_poses,
    invert_pose,
    rotate_by,
    rotation_between,
    vector6,
)
from robot.world.contact_force import force_error, wall_distance
from tactile.base.random_streams import stream

ZERO: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NEAR: Vector6 = (0.0, -1.6, -1.6, -1.6, 1.57, 0.0)  # posture at the start, rad: elbow up, tool down
SMALL = 1e-9  # least speed and acceleration; the client accepts 0, at which a move never ends


class Unreachable(ValueError):
    """No joint solution for a pose."""


class _MotionState(NamedTuple):
    """State of the arm.

    Attributes:
        tcp: [6] tool pose in the base frame, m and rotation vector rad. speed: [6] tool speed, m/s and rad/s.
        joints: [6] rad. joint_speed: [6] rad/s.
    """

    tcp: Vector6
    speed: Vector6
    joints: Vector6
    joint_speed: Vector6


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


class _LinearMotion(NamedTuple):
    """A straight move of the tool to a pose; its rotation is proportional to the distance."""

    start: Vector6
    way: Vector6  # translation m and rotation vector rad, in the base frame
    profile: Profile
    time: float = 0.0

    def advance(self, dt: float) -> tuple[Vector6, Vector6, _LinearMotion | None]:
        time = self.time + dt
        done, rate = self.profile.at(time)
        length = self.profile.length or 1.0
        rest = None if time >= self.profile.duration else self._replace(time=time)
        return _move(self.start, _scale(self.way, done / length)), _scale(self.way, rate / length), rest


def _scale(vector: Iterable[float], scale: float) -> Vector6:
    return vector6(x * scale for x in vector)


def _move(tcp: Vector6, way: Vector6) -> Vector6:
    """A tool pose after a translation and a rotation in the base frame."""
    return (tcp[0] + way[0], tcp[1] + way[1], tcp[2] + way[2], *rotate_by(tcp, way[3:]))


class MoveL(NamedTuple):
    """A straight move to a tool pose, with speed in m/s and acceleration in m/s^2."""

    goal: Vector6
    speed: float
    acceleration: float


class StopL(NamedTuple):
    """A stop of the tool, with deceleration in m/s^2; it is its own motion."""

    acceleration: float

    def advance(self, state: _MotionState, dt: float, ratio: float) -> tuple[Vector6, Vector6, StopL | None]:
        """Slows translation and rotation down; `ratio` (rad/m) relates their decelerations."""
        slowed: list[float] = []
        step = self.acceleration * dt
        for now, most in ((state.speed[:3], step), (state.speed[3:], step * ratio)):
            length = math.hypot(*now)
            slowed += [0.0 if length <= most else v - v * most / length for v in now]
        speed = vector6(slowed)
        return _move(state.tcp, _scale(speed, dt)), speed, self if any(speed) else None


MoveOrder = MoveL | StopL


_MOVE = re.compile(r"^\s*movel\(p\[(?P<pose>[^]]*)\](?P<limits>[^)]*)\)\s*$")
_LIMIT = re.compile(r"\b([av])\s*=\s*([-+.\deE]+)")


def parse_moves(text: str) -> list[MoveL]:
    """The lines `movel(p[...], a=..., v=...)` of URScript text; all other lines are ignored."""
    moves = []
    for match in filter(None, map(_MOVE.match, text.splitlines())):
        with contextlib.suppress(ValueError):  # not numbers: the line is ignored
            goal = vector6(map(float, match["pose"].split(",")))
            given = {name: float(value) for name, value in _LIMIT.findall(match["limits"])}
            limits = {"a": 1.2, "v": 0.25} | given
            moves.append(MoveL(goal, limits["v"], limits["a"]))
    return moves


class _PokedWalls:
    """The walls of a maze, and the errors of the measured force."""

    def __init__(self, config: PokedWallsConfig) -> None:
        self._config, self._boxes = config, np.array(config.boxes, np.float64).reshape(-1, 4)
        self._random = stream(config.seed, "emulator.force")

    def push(self, tcp: Vector6) -> tuple[float, list[float]]:
        """Depth of a tool (pose [6]) in the walls, m, and the force that the arm measures [3], N."""
        config, depth, force = self._config, 0.0, np.zeros(3)
        pose, lift = config.placing.pose_from_tcp(np.array(tcp))
        if len(self._boxes) and lift < config.top:
            gap, outwards = wall_distance(self._boxes, pose[:2])
            depth, turn = max(0.0, config.radius - float(gap)), np.radians(config.placing.yaw_deg)
            c, s = np.cos(turn), np.sin(turn)
            force[:2] = config.force.stiffness * depth * (np.array([[c, -s], [s, c]]) @ outwards)
        noise = config.force.noise * self._random.standard_normal(3)
        return depth, (force + force_error(config.force, pose) + noise).tolist()


class EmulatedArm:
    """State of the emulated arm.

    Attributes:
        state: joints and tool. force: [6] at the tool in the base frame, N and Nm. penetration_max: largest
            depth in a wall, m. scale: speed slider, 0 to 1.
    """

    def __init__(self, config: UrEmulatorConfig) -> None:
        self._geometry = UR10 if config.version[0] < 5 else UR10E
        self._tool = self._tool_back = ZERO  # pose of the tool in the flange, and its inverse
        self.walls = list(config.walls)
        self._poked = None if config.poked is None else _PokedWalls(config.poked)
        self.turn_ratio = config.turn_ratio
        self.scale = 1.0
        self.force: Vector6 = ZERO
        self.penetration_max = 0.0
        self._motion: _LinearMotion | StopL | None = None
        self._order: MoveOrder | None = None
        self._queue: deque[MoveOrder] = deque()
        self.state = _MotionState(config.start, ZERO, NEAR, ZERO)
        self.place(config.start)

    @property
    def busy(self) -> bool:
        """Whether the arm moves or has unfinished orders."""
        return self._motion is not None or bool(self._queue)

    @property
    def moving(self) -> bool:
        return any(self.state.speed) or any(self.state.joint_speed)

    @property
    def remaining(self) -> list[MoveOrder]:
        """Unfinished orders."""
        return ([self._order] if self._order is not None else []) + list(self._queue)

    def place(self, tcp: Vector6) -> None:
        """Sets the tool pose [6] (m, rotation vector rad) at once. Raises `Unreachable`."""
        self.state = _MotionState(tcp, ZERO, self.solve(tcp), ZERO)
        self.order(())
        self._update_force()

    def set_tool(self, tool: Vector6) -> None:
        """Sets the tool's pose [6] in the flange frame (m, rotation vector rad); the joints stay."""
        self._tool, self._tool_back = tool, invert_pose(tool)
        self.state = self.state._replace(tcp=compose_poses(self._geometry.forward(self.state.joints), tool))

    def solve(self, tcp: Vector6) -> Vector6:
        """Joints [6] (rad), near the present ones, for a tool pose [6]. Raises `Unreachable`."""
        joints = self._geometry.backward(compose_poses(tcp, self._tool_back), self.state.joints)
        if joints is None:
            raise Unreachable(f"no joints for {[round(number, 4) for number in tcp]}")
        return joints

    def order(self, orders: Iterable[MoveOrder]) -> None:
        """Replaces all orders. A move stops a moving arm first, since moves start at rest."""
        self._queue = deque(orders)
        if self.moving and self._queue and isinstance(first := self._queue[0], MoveL):
            self._queue.appendleft(StopL(first.acceleration))
        self._motion, self._order = None, None

    def halt(self, acceleration: float) -> None:
        """Drops all orders and stops with a deceleration, m/s^2."""
        self._queue.clear()
        self._order = None
        self._motion = StopL(acceleration) if self.moving else None

    def step(self, dt: float) -> None:
        """Advances by a control step, s. Raises `Unreachable` and stops at once if the pose has no joints."""
        try:
            while self._motion is None and self._queue:
                self._order = self._queue.popleft()
                self._motion = self._start(self._order)
            if self._motion is not None:
                self._advance(self._motion, dt)
        except Unreachable:
            self.order(())
            self._rest()
            raise
        self._update_force()

    def _start(self, order: MoveOrder) -> _LinearMotion | StopL | None:
        """The motion that executes an order; None if the tool is at the goal already."""
        state, ratio, acceleration = self.state, self.turn_ratio, max(order.acceleration, SMALL)
        if isinstance(order, StopL):
            return StopL(acceleration)
        self.solve(order.goal)
        speed = max(order.speed, SMALL)
        x, y, z = (g - s for g, s in zip(order.goal[:3], state.tcp[:3], strict=True))
        way = (x, y, z, *rotation_between(state.tcp, order.goal))
        # The slower of translation and rotation sets the duration.
        straight = Profile(math.hypot(*way[:3]), speed, acceleration)
        turning = Profile(math.hypot(*way[3:]), speed * ratio, acceleration * ratio)
        slower = max(straight, turning, key=lambda profile: profile.duration)
        return _LinearMotion(state.tcp, way, slower) if slower.length > 0 else None

    def _advance(self, motion: _LinearMotion | StopL, dt: float) -> None:
        scale = 1.0 if isinstance(motion, StopL) else self.scale
        if scale <= 0:
            self._rest()
            return
        if isinstance(motion, StopL):
            tcp, speed, self._motion = motion.advance(self.state, dt, self.turn_ratio)
        else:
            tcp, speed, self._motion = motion.advance(dt * scale)
        after = self.solve(tcp)
        turned = (new - old for new, old in zip(after, self.state.joints, strict=True))
        rate = _scale(turned, 1 / (dt * scale))
        self.state = _MotionState(tcp, _scale(speed, scale), after, _scale(rate, scale))
        if self._motion is None:
            self._order = None
            self._rest()

    def _rest(self) -> None:
        self.state = self.state._replace(speed=ZERO, joint_speed=ZERO)

    def _update_force(self) -> None:
        """Walls are linear springs."""
        depths = [wall.depth(self.state.tcp) for wall in self.walls]
        force = [0.0, 0.0, 0.0]
        for wall, depth in zip(self.walls, depths, strict=True):
            force["xyz".index(wall.axis)] -= wall.solid * wall.stiffness * depth
        if self._poked is not None:
            depth, felt = self._poked.push(self.state.tcp)
            depths, force = [*depths, depth], [sum(pair) for pair in zip(force, felt, strict=True)]
        self.force = vector6([*force, 0.0, 0.0, 0.0])
        self.penetration_max = max([self.penetration_max, *depths])
