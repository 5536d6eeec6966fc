"""Route of the arm: a sequence of targets, each sent after arrival at the previous one."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from robot.drivers.outcome import Fault
from robot.drivers.ur10.safety import TargetRefused
from robot.drivers.ur10.safety import check_target as allowed
from robot.live.live_config import LiveConfig
from robot.simulation.head.simulated_session import SimulationConfig
from robot.world.scene import HeadPath, Scene, make_scene
from tactile.base.errors import InputError
from tactile.whisker_geometry import Head


class MovableArm(Protocol):
    """The methods of `robot.drivers.ur10.arm.Arm` that a route calls."""

    @property
    def fault(self) -> Fault | None: ...
    def move(self, tcp: np.ndarray, speed: float | None = None) -> object: ...
    def arrived(self) -> bool: ...
    def halt(self) -> None: ...


class ArmRoute(Protocol):
    """What the whisk loop asks of a route."""

    def advance(self, arm: MovableArm) -> bool:
        """Sends the arm on if necessary; returns whether it is at the end.

        Raises:
            robot.drivers.ur10.safety.TargetRefused: a target is rejected.
        """
        ...

    def resend_last(self) -> None:
        """Sends the last target again with the next `advance`, after a stop on the way to it."""
        ...


class _Route:
    """Targets [K, 6] in the arm's base frame, at a speed (m/s)."""

    def __init__(self, targets: np.ndarray, speed: float) -> None:
        self.targets, self.speed = targets, speed
        self.sent = 0

    def advance(self, arm: MovableArm) -> bool:
        """See `ArmRoute`; a target is sent when the arm has arrived at the one before."""
        if self.sent and not arm.arrived():
            return False
        if self.sent == len(self.targets):
            return True
        arm.move(self.targets[self.sent], self.speed)
        self.sent += 1
        return False

    def resend_last(self) -> None:
        """See `ArmRoute`."""
        self.sent = max(self.sent - 1, 0)


def plan_path(config: LiveConfig, head: Head) -> HeadPath:
    """Poses of the head in the map over time, for motion without interruptions; with goals only the first.

    Raises:
        InputError: the path cannot be planned or is empty.
    """
    goal = config.plan.goal
    if goal is not None and goal.at is not None:
        return HeadPath(np.zeros(1), np.array([[*goal.at[:2], np.radians(goal.at[2])]]))
    path = whole_path(config, head)
    return path if goal is None else HeadPath(np.zeros(1), path.pose[-1:])  # the arm starts at the end


def whole_path(config: LiveConfig, head: Head) -> HeadPath:
    """The path of the waypoints or of the plan, whatever the goals."""
    if not config.waypoints:
        made = plan_scene(config.plan, head)
        if len(made.jumps):
            raise InputError("live.plan.kidnaps", "kidnaps", "none on an arm", "remove them from the plan")
        keep = made.path.time <= made.duration
        return HeadPath(made.path.time[keep], made.path.pose[keep])
    pose = np.array(config.waypoints)
    pose[:, 2] = np.unwrap(np.radians(pose[:, 2]))
    if len(pose) < 2 and config.plan.goal is None:
        raise InputError("live.waypoints", "one", "at least two")
    step = np.abs(np.diff(pose, axis=0))
    motion = config.plan.motion
    took = np.maximum(np.hypot(step[:, 0], step[:, 1]) / motion.speed, step[:, 2] / motion.turn_rate)
    return HeadPath(np.concatenate([[0.0], np.cumsum(took)]), pose)


def plan_scene(plan: SimulationConfig, head: Head) -> Scene:
    """The maze of a plan and the path in it."""
    return make_scene(plan.maze, plan.path, plan.motion, plan.kidnaps, head, plan.seed)


def arm_routes(config: LiveConfig, path: HeadPath) -> tuple[_Route, _Route, _Route]:
    """From the present pose of the arm to above the first pose of a path; down to it; along the path, without
    its first pose, where the arm starts."""
    place, speed = config.arm.placing.tcp_from_pose, config.route_speed
    above, first, rest = place(path.pose[:1], config.lift), place(path.pose[:1]), place(path.pose[1:])
    return _Route(above, speed), _Route(first, speed), _Route(rest, speed)


def check_targets(config: LiveConfig, path: HeadPath) -> None:
    """Checks every target before the arm moves.

    Raises:
        InputError: a target is rejected; the error gives its number and the reason.
    """
    targets = np.concatenate([route.targets for route in arm_routes(config, path)])
    before = targets[0]
    for target in targets:
        try:
            allowed(config.arm, target, before)
        except TargetRefused as error:
            where = "live.waypoints" if config.waypoints else "live.plan.path"
            raise InputError(where, str(error), cure="move them, or `live.arm.placing`") from None
        before = target
