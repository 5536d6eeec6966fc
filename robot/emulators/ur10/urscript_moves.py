"""Orders to the arm (straight move, stop), their motions, and the parsing of moves in URScript text."""

from __future__ import annotations

import contextlib
import re
from typing import NamedTuple

from robot.emulators.ur10.motion import (
    ZERO,
    ArmModel,
    LinearMotion,
    Motion,
    MotionState,
    ToolSpeedMotion,
    linear_motion,
)
from robot.emulators.ur10.rotations import Vector6

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
