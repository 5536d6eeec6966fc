"""The control program that ur_rtde uploads, emulated at its registers.

The client writes the number of a command into integer register 0 and its arguments into others. The program
writes 1 to output register 0 when it is ready and 2 when it has executed a command; then the client writes 0.
Output register 2 describes the newest asynchronous operation: its number and whether it is under way.
Source: the interface described by ur_rtde 1.6.5 (its control script and its documentation).

The commands of our driver are executed: `moveL`, `stopL`, `setTcp`, `setWatchdog`,
`isPoseWithinSafetyLimits`. Any other command ends the program, as an error in a script does on a controller:
the function of ur_rtde returns False or raises an error, and the emulator names it on standard error.
Functions that do not wait for an answer (`servoJ`, `speedL`, ...) return True the first time, but end the
program too.

Numbers of ur_rtde's commands to its control program.

The numbers were read from the register while ur_rtde 1.6.5 called the function of each name.
"""

from __future__ import annotations

import re
import sys
from enum import IntEnum

from robot.emulators.ur10.controller import EmulatedController, Program
from robot.emulators.ur10.motion import MoveL, MoveOrder, StopL, parse_moves

READY, DONE = 1, 2
RUNNING_BIT = 1 << 15

_OFFSET = re.compile(r"# int register offset\n\s*(\d+)")


class ControlProgram:
    """The running control program of ur_rtde.

    Args:
        controller: executes the commands. text: the uploaded program.
    """

    def __init__(self, controller: EmulatedController, text: str) -> None:
        offset = _OFFSET.search(text)
        self._offset = int(offset[1]) if offset else 0  # first integer and double register in use
        self._controller, self._registers = controller, controller.registers
        self._executing = False
        self._waiting = False  # the command is done when the arm is
        self._operating = False  # an asynchronous move or stop is in progress
        self._writes = self._operation = 0
        self._report_operation(running=False)
        self._answer(READY)

    def step(self) -> bool:
        """Runs one control step; False when the program has ended. `Unreachable` ends it too."""
        busy = self._controller.arm.busy
        if not busy:
            self._end_operation()
        if self._waiting:
            if busy:
                return True
            self._waiting = False
            self._answer(DONE)
        command = self._registers.ints[self._offset]
        if command == ControlCommand.NONE:
            self._executing = False
            self._answer(READY)
        elif not self._executing:
            self._executing = True
            if command == ControlCommand.END:
                return False
            if refusal := refusal_of(command):
                print(f"emulated controller: {refusal}", file=sys.stderr, flush=True)
                return False
            self._execute(command)
            if not self._waiting:
                self._answer(DONE)
        return True

    def _execute(self, command: int) -> None:
        controller, first = self._controller, self._registers.doubles[self._offset]
        vector = self._registers.vector(self._offset)
        if command == ControlCommand.MOVE_L:
            controller.solve(vector)
            speed, acceleration = self._registers.doubles[self._offset + 6 : self._offset + 8]
            self._order("movel", MoveL(vector, speed, acceleration))
        elif command == ControlCommand.STOP_L:
            self._order("stop", StopL(first))
        elif command == ControlCommand.SET_TCP:
            controller.arm.set_tool(vector)
        elif command == ControlCommand.SET_WATCHDOG:
            controller.watch(first, self._offset)
        elif command == ControlCommand.POSE_WITHIN_SAFETY_LIMITS:
            self._registers.put_int(self._offset + 1, int(controller.solvable(vector)))

    def _order(self, kind: str, order: MoveOrder) -> None:
        """Replaces the arm's orders; an asynchronous command is done at once, any other with the arm."""
        self._end_operation()
        self._controller.record_target(kind, order)
        self._controller.arm.order([order])
        if self._registers.ints[self._offset + 1] == 1:
            self._operating = True
            self._report_operation(running=True)
        else:
            self._waiting = True

    def _answer(self, word: int) -> None:
        self._registers.put_int(self._offset, word)

    def _end_operation(self) -> None:
        if self._operating:
            self._operating = False
            self._report_operation(running=False)

    def _report_operation(self, *, running: bool) -> None:
        """Writes the state of the asynchronous operation; `running` starts a new one."""
        self._writes = (self._writes + 1) % 128
        self._operation = (self._operation + running) % 128
        word = self._writes << 16 | self._operation << 24 | RUNNING_BIT * running
        self._registers.put_int(self._offset + 2, word)


class ScriptProgram:
    """Any other program: executes its linear moves in order, then ends."""

    def __init__(self, controller: EmulatedController, text: str) -> None:
        self._controller = controller
        moves = parse_moves(text)
        for move in moves:
            controller.record_target("script", move)
        controller.arm.order(moves)

    def step(self) -> bool:
        """Runs one control step; False when the program has ended."""
        return self._controller.arm.busy


def load_program(controller: EmulatedController, text: str) -> Program:
    """Starts uploaded program text on a controller: ur_rtde's control program, or any other script."""
    return (ControlProgram if "def rtde_control" in text else ScriptProgram)(controller, text)


class ControlCommand(IntEnum):
    """Commands that the emulated control program executes."""

    NONE = 0
    MOVE_L = 3
    SET_TCP = 29
    STOP_L = 33
    SET_WATCHDOG = 35
    POSE_WITHIN_SAFETY_LIMITS = 36
    END = 255


EMULATED = "moveL, setTcp, stopL, setWatchdog, isPoseWithinSafetyLimits, stopScript"
"""Functions of ur_rtde that send these commands."""

REFUSED = {
    1: "moveJ", 2: "moveJ_IK", 4: "moveL_FK", 6: "forceMode", 7: "forceModeStop", 8: "zeroFtSensor",
    9: "speedJ", 10: "speedL", 11: "servoJ", 12: "servoC", 15: "speedStop", 16: "servoStop", 17: "setPayload",
    18: "teachMode", 19: "endTeachMode", 20: "forceModeSetDamping", 21: "forceModeSetGainScaling",
    24: "servoL", 25: "toolContact", 26: "getStepTime", 27: "getActualJointPositionsHistory",
    28: "getTargetWaypoint", 31: "triggerProtectiveStop", 34: "stopJ", 37: "isJointsWithinSafetyLimits",
    38: "getJointTorques", 39: "poseTrans", 40: "getTCPOffset", 41: "jogStart", 42: "jogStop",
    43: "getForwardKinematics", 45: "movePath", 46: "getInverseKinematics", 47: "isSteady",
    51: "moveUntilContact", 52: "freedriveMode", 53: "endFreedriveMode", 54: "getFreedriveStatus",
    56: "ftRtdeInputEnable", 57: "enableExternalFtSensor", 58: "getActualToolFlangePose", 59: "setGravity",
    60: "getInverseKinematicsHasSolution", 62: "startContactDetection", 63: "stopContactDetection",
    64: "readContactDetection", 65: "setTargetPayload", 66: "directTorque", 67: "getMassMatrix",
    68: "getCoriolisAndCentrifugalTorques", 69: "getTargetJointAccelerations", 70: "getJacobian",
    71: "getJacobianTimeDerivative",
}  # fmt: skip
"""Functions of ur_rtde by the number of a command that is not emulated."""


def refusal_of(command: int) -> str:
    """Reason for refusing a command, one line; empty if it is emulated."""
    if command in set(ControlCommand):
        return ""
    name = REFUSED.get(command, "an unknown function")
    return f"{name} (command {command}) is not emulated and ends the control program; emulated are {EMULATED}"
