"""The emulated arm: executes orders in control steps; walls push its tool."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

from robot.emulators.ur10 import motion as motions
from robot.emulators.ur10.emulator_config import UrEmulatorConfig, WallConfig
from robot.emulators.ur10.kinematics import UR10, UR10E, Vector6
from robot.emulators.ur10.motion import (
    ZERO,
    ArmModel,
    LinearMotion,
    Motion,
    MotionState,
    MoveL,
    MoveOrder,
    StopL,
    ToolSpeedMotion,
    Unreachable,
    start_motion,
)

NEAR: Vector6 = (0.0, -1.6, -1.6, -1.6, 1.57, 0.0)  # posture at the start, rad: elbow up, tool down


class EmulatedArm:
    """State of the emulated arm.

    Attributes:
        state: joints and tool. force: [6] at the tool in the base frame, N and Nm. penetration_max: largest
        depth in a wall, m. scale: speed slider, 0 to 1.
    """

    def __init__(self, config: UrEmulatorConfig) -> None:
        self.model: ArmModel = ArmModel(UR10 if config.version.major < 5 else UR10E)
        self.walls = list(config.walls)
        self.turn_ratio = config.turn_ratio
        self.scale = 1.0
        self.force: Vector6 = ZERO
        self.penetration_max = 0.0
        self._motion: Motion | None = None
        self._order: MoveOrder | None = None
        self._queue: deque[MoveOrder] = deque()
        tcp = config.start
        self.state: MotionState = MotionState(tcp, ZERO, self.model.backward(tcp, NEAR), ZERO)
        self._update_force()

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
        self.state = MotionState(tcp, ZERO, self.model.backward(tcp, self.state.joints), ZERO)
        self._motion, self._order = None, None
        self._queue.clear()
        self._update_force()

    def set_tool(self, tool: Vector6) -> None:
        """Sets the tool's pose [6] in the flange frame (m, rotation vector rad); the joints stay."""
        self.model = self.model.with_tool(tool)
        self.state = self.state._replace(tcp=self.model.forward(self.state.joints))

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
        self._motion = ToolSpeedMotion(ZERO, acceleration, self.turn_ratio) if self.moving else None

    def step(self, dt: float) -> None:
        """Advances by a control step, s. Raises `Unreachable` and stops at once if the pose has no joints."""
        try:
            while self._motion is None and self._queue:
                self._order = self._queue.popleft()
                self._motion = start_motion(self._order, self.model, self.state, self.turn_ratio)
            if self._motion is not None:
                self._advance(dt)
        except Unreachable:
            self._motion, self._order = None, None
            self._queue.clear()
            self._rest()
            raise
        self._update_force()

    def _advance(self, dt: float) -> None:
        assert self._motion is not None
        scale = self.scale if isinstance(self._motion, LinearMotion) else 1.0
        if scale <= 0:
            self._rest()
            return
        state, self._motion = self._motion.advance(self.model, self.state, dt * scale)
        if scale != 1.0:
            speed, rate = motions.scale(state.speed, scale), motions.scale(state.joint_speed, scale)
            state = state._replace(speed=speed, joint_speed=rate)
        self.state = state
        if self._motion is None:
            self._order = None
            self._rest()

    def _rest(self) -> None:
        self.state = self.state._replace(speed=ZERO, joint_speed=ZERO)

    def _update_force(self) -> None:
        if not self.walls:
            self.force = ZERO
            return
        self.force = wall_force(self.walls, self.state.tcp)
        deepest = max(penetration(wall, self.state.tcp) for wall in self.walls)
        self.penetration_max = max(self.penetration_max, deepest)


def penetration(wall: WallConfig, tcp: Vector6) -> float:
    """Depth of the tool in a wall, m; 0 outside."""
    return max(0.0, wall.solid * (tcp["xyz".index(wall.axis)] - wall.at))


def wall_force(walls: Iterable[WallConfig], tcp: Vector6) -> Vector6:
    """Force [6] of the walls on the tool, N: linear springs."""
    force = [0.0, 0.0, 0.0]
    for wall in walls:
        force["xyz".index(wall.axis)] -= wall.solid * wall.stiffness * penetration(wall, tcp)
    return force[0], force[1], force[2], 0.0, 0.0, 0.0


def force_magnitude(force: Vector6) -> float:
    """Magnitude of a force, N."""
    return math.hypot(*force[:3])
