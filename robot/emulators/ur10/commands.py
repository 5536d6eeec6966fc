"""What each command of ur_rtde's control program does; numbers and places of arguments are the client's.

Not here, so accepted without an effect: force mode (6), zeroing and payloads (8, 17, 59, 65), teaching and
freedrive (18, 19, 52, 53), damping and gains (20, 21), moving until contact (51: as on a CB3, where it does
nothing and is answered with yes), external sensors (55 to 57), contact detection (62), dynamics (66 to 71).
"""

from __future__ import annotations

from collections.abc import Callable

from robot.emulators.ur10.control_program import ControlProgram
from robot.emulators.ur10.motion import ZERO
from robot.emulators.ur10.rotation import compose_poses, invert_pose, quaternion, rotate
from robot.emulators.ur10.urscript_moves import MoveJ, MoveL, Servo, SpeedJ, SpeedL, StopL

SERVO_C_LAG = 0.1  # s


def _move_j(p: ControlProgram) -> None:
    p.move([MoveJ(p.vector(), p.number(6), p.number(7))], "movej")


def _move_j_ik(p: ControlProgram) -> None:
    joints = p.controller.solve(p.vector(), p.arm.state.joints)
    p.move([MoveJ(joints, p.number(6), p.number(7))], "movej")


def _move_l(p: ControlProgram) -> None:
    p.controller.solve(p.vector(), p.arm.state.joints)
    p.move([MoveL(p.vector(), p.number(6), p.number(7))], "movel")


def _move_l_fk(p: ControlProgram) -> None:
    p.move([MoveL(p.arm.model.forward(p.vector()), p.number(6), p.number(7))], "movel")


def _servo_to_pose(lag: float | None) -> Callable[[ControlProgram], None]:
    def do(p: ControlProgram) -> None:
        joints = p.controller.solve(p.vector(), p.arm.state.joints)
        p.repeat(Servo(joints, p.number(9) if lag is None else lag), "servol")

    return do


def _jog(p: ControlProgram) -> None:
    """At a speed in the base (0), the tool's frame now (1) or a frame of its own (2)."""
    frame = {1: p.arm.state.tcp, 2: p.vector(8)}.get(int(p.number(6)), ZERO)
    turn = quaternion(frame[3:])
    speed = (*rotate(turn, p.vector()[:3]), *rotate(turn, p.vector()[3:]))
    p.repeat(SpeedL(speed, p.number(7)), "jog")


def _inverse(near: bool) -> Callable[[ControlProgram], None]:
    return lambda p: p.put(p.controller.solve(p.vector(), p.vector(6) if near else p.arm.state.joints))


def _solvable(p: ControlProgram) -> None:
    p.result(int(p.controller.solvable(p.vector())))


COMMANDS: dict[int, Callable[[ControlProgram], None]] = {
    1: _move_j,
    2: _move_j_ik,
    3: _move_l,
    4: _move_l_fk,
    7: lambda p: p.stop(StopL(10.0)),  # the end of force mode
    9: lambda p: p.repeat(SpeedJ(p.vector(), p.number(6)), "speedj"),
    10: lambda p: p.repeat(SpeedL(p.vector(), p.number(6)), "speedl"),
    11: lambda p: p.repeat(Servo(p.vector(), p.number(9)), "servoj"),
    12: _servo_to_pose(SERVO_C_LAG),
    15: lambda p: p.end_repeated(p.number(0)),
    16: lambda p: p.stop(StopL(p.number(0))),
    24: _servo_to_pose(None),
    25: lambda p: p.result(0),  # steps since a contact: never one
    26: lambda p: p.put([p.controller.dt]),
    27: lambda p: p.put(p.arm.state.joints),  # joints some steps ago: there is no history
    28: lambda p: p.put(p.controller.waypoint),
    29: lambda p: p.arm.set_tool(p.vector()),
    30: _inverse(near=True),
    31: lambda p: p.controller.protective_stop(),
    33: lambda p: p.stop_either(p.number(0)),
    34: lambda p: p.stop_either(p.number(0)),
    35: lambda p: p.controller.watch(p.number(0), p.offset),
    36: _solvable,  # within the safety limits: what can be reached is
    37: lambda p: p.result(1),
    38: lambda p: p.put(ZERO),
    39: lambda p: p.put(compose_poses(p.vector(), p.vector(6))),
    40: lambda p: p.put(p.arm.model.tool),
    41: _jog,
    42: lambda p: p.stop(StopL(1.2)),
    43: lambda p: p.put(p.arm.state.tcp),
    44: lambda p: p.put(p.arm.model.with_tool(p.vector(6)).forward(p.vector())),
    45: lambda p: p.move(p.path, "path"),
    46: _inverse(near=False),
    47: lambda p: p.result(int(not p.arm.moving)),
    54: lambda p: p.result(0),
    58: lambda p: p.put(compose_poses(p.arm.state.tcp, invert_pose(p.arm.model.tool))),
    60: _solvable,
    61: _solvable,
    63: lambda p: p.result(0),
    64: lambda p: p.result(0),
}
