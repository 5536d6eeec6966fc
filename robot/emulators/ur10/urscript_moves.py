"""What a program tells the arm to do, in order, and how each order becomes a motion from where the arm is."""

from __future__ import annotations

import contextlib
import re
from typing import NamedTuple

from robot.emulators.ur10.motion import (
    ZERO,
    ArmModel,
    JointSpeedMotion,
    Motion,
    MotionState,
    ServoMotion,
    ToolSpeedMotion,
    joint_motion,
    linear_motion,
)
from robot.emulators.ur10.rotation import Vector6

SMALL = 1e-9  # speeds and accelerations of 0 are let through by the client: they would never arrive


class MoveL(NamedTuple):
    """Straight to a pose, m/s and m/s^2."""

    goal: Vector6
    speed: float
    acceleration: float
    blend: float = 0.0


class MoveJ(NamedTuple):
    """To joints, rad/s and rad/s^2."""

    goal: Vector6
    speed: float
    acceleration: float
    blend: float = 0.0


class SpeedL(NamedTuple):
    """At a speed of the tool, m/s and rad/s, until told otherwise."""

    goal: Vector6
    acceleration: float


class SpeedJ(NamedTuple):
    """At joint speeds, rad/s, until told otherwise."""

    goal: Vector6
    acceleration: float


class Servo(NamedTuple):
    """After joints, rad, lagging by s."""

    goal: Vector6
    lag: float


class StopL(NamedTuple):
    """To rest along the tool's way, m/s^2."""

    acceleration: float


class StopJ(NamedTuple):
    """To rest along the joints' way, rad/s^2."""

    acceleration: float


class Mark(NamedTuple):
    """Takes no time: tells the program how far it is."""

    progress: int


MoveOrder = MoveL | MoveJ | SpeedL | SpeedJ | Servo | StopL | StopJ | Mark


def start_motion(order: MoveOrder, model: ArmModel, state: MotionState, turn_ratio: float) -> Motion | None:
    """The motion that an order is. Raises `Unreachable` where it leads nowhere."""
    if isinstance(order, MoveL):
        model.backward(order.goal, state.joints)
        way = linear_motion(
            state, order.goal, max(order.speed, SMALL), max(order.acceleration, SMALL), turn_ratio
        )
        return way if way.profile.length > 0 else None
    if isinstance(order, MoveJ):
        way_q = joint_motion(state, order.goal, max(order.speed, SMALL), max(order.acceleration, SMALL))
        return way_q if way_q.profile.length > 0 else None
    if isinstance(order, SpeedL):
        return ToolSpeedMotion(order.goal, order.acceleration, turn_ratio)
    if isinstance(order, SpeedJ):
        return JointSpeedMotion(order.goal, order.acceleration)
    if isinstance(order, Servo):
        return ServoMotion(order.goal, max(order.lag, 1e-3))
    if isinstance(order, StopL):
        return ToolSpeedMotion(ZERO, max(order.acceleration, SMALL), turn_ratio)
    if isinstance(order, StopJ):
        return JointSpeedMotion(ZERO, max(order.acceleration, SMALL))
    return None


def renews(order: MoveOrder, motion: Motion) -> bool:
    """Whether an order only renews the goal of a motion that goes on."""
    pairs = (SpeedL, ToolSpeedMotion), (SpeedJ, JointSpeedMotion), (Servo, ServoMotion)
    return any(isinstance(order, told) and isinstance(motion, done) for told, done in pairs)


_LINE = re.compile(
    r"^\s*(?:(?P<move>move[ljp])\((?P<pose>p?)\[(?P<numbers>[^]]*)\](?P<rest>[^)]*)\)"
    r"|(?P<stop>stop[lj])\((?:a=)?(?P<rate>[^)]*)\)|signal_async_progress\((?P<mark>\d+)\))\s*$"
)
_ARGUMENT = re.compile(r"\b([avr])\s*=\s*([-+.\deE]+)")
_DEFAULTS = {"movel": {"a": 1.2, "v": 0.25, "r": 0.0}, "movej": {"a": 1.4, "v": 1.05, "r": 0.0}}


def parse_orders(text: str) -> list[MoveOrder]:
    """The moves, stops and marks in URScript text, as the client writes paths. Other lines are passed over.

    Moves to a pose become `MoveL` also where they are written movej: there is no joint target in the text.
    """
    found: list[MoveOrder] = []
    for written in text.splitlines():
        match = _LINE.match(written)
        if match is not None:
            with contextlib.suppress(ValueError):  # a number that is none: another line that is not ours
                found.append(_order(match))
    return found


def _order(match: re.Match[str]) -> MoveOrder:
    """One line as an order. Raises ValueError where its numbers are none."""
    if match["mark"] is not None:
        return Mark(int(match["mark"]))
    if match["stop"] is not None:
        rate = float(match["rate"].split(",")[0])
        return StopL(rate) if match["stop"] == "stopl" else StopJ(rate)
    x, y, z, rx, ry, rz = (float(number) for number in match["numbers"].split(","))
    joints = match["move"] == "movej" and not match["pose"]
    named = dict(_DEFAULTS["movej" if joints else "movel"])
    named.update((name, float(number)) for name, number in _ARGUMENT.findall(match["rest"]))
    kind = MoveJ if joints else MoveL
    return kind((x, y, z, rx, ry, rz), named["v"], named["a"], named["r"])
