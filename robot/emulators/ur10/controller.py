"""The emulated controller without sockets: arm, safety, registers, and the programs that clients upload.

Of uploaded programs it runs the control program of ur_rtde, emulated at its registers, and any other as the
list of its linear moves.
"""

from __future__ import annotations

import math
import re
import sys
from collections import deque
from enum import IntEnum
from typing import Any

from robot.drivers.ur10.rtde_protocol import OUTPUT_TYPES, REGISTERS
from robot.emulators.ur10.emulated_arm import EmulatedArm, MoveL, MoveOrder, StopL, Unreachable, parse_moves
from robot.emulators.ur10.emulator_config import UrEmulatorConfig
from robot.emulators.ur10.kinematics import Vector6, vector6

MAX_TARGETS = 10_000  # orders kept for the fault request "state"

Value = tuple[float, ...]

_LENGTH = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6}
_CONSTANT: dict[str, Value] = {
    "speed_scaling": (1.0,),
    "target_speed_fraction": (1.0,),
    "actual_main_voltage": (48.0,),
    "actual_robot_voltage": (48.0,),
    "actual_joint_voltage": (48.0,) * 6,
    "joint_temperatures": (30.0,) * 6,
    "actual_tool_accelerometer": (0.0, 0.0, 9.82),
    "joint_mode": (253,) * 6,  # running
}


class Registers:
    """Outputs and inputs of the controller.

    Attributes:
        fields: every output variable by name, as a tuple of its numbers.
        ints, doubles: input registers. written: host time at which each input integer was last written, s.
        inputs: the other input variables, by name.
    """

    def __init__(self) -> None:
        self.fields: dict[str, Value] = {
            name: _CONSTANT.get(name, (0,) * _LENGTH.get(kind, 1)) for name, kind in OUTPUT_TYPES.items()
        }
        self.ints = [0] * REGISTERS
        self.doubles = [0.0] * REGISTERS
        self.written = [0.0] * REGISTERS
        self.inputs: dict[str, Value] = {}

    def write(self, name: str, value: Value, time: float) -> None:
        """Stores an input variable of a client, received at a host time, s."""
        kind, _, index = name.rpartition("_")
        if kind == "input_int_register":
            self.ints[int(index)] = int(value[0])
            self.written[int(index)] = time
        elif kind == "input_double_register":
            self.doubles[int(index)] = value[0]
        else:
            self.inputs[name] = value

    def put_int(self, index: int, value: int) -> None:
        self.fields[f"output_int_register_{index}"] = (value,)


class SafetyMode(IntEnum):
    """Safety mode: the reason why the arm may not move, if any."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7


class RobotMode(IntEnum):
    """Power state of the arm."""

    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


class Runtime(IntEnum):
    """State of the program."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


SAFETY_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,
    SafetyMode.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
"""`safety_status_bits` of RTDE: 0 normal, 2 protective stop, 4 safeguard stop, 6 emergency stop of the robot,
7 emergency stop, 10 stopped due to safety."""
POWER_ON, PROGRAM_RUNNING = 1 << 0, 1 << 1
"""`robot_status_bits` of RTDE."""


class EmulatedController:
    """An emulated controller. `tick` runs a control step; clients call the other methods between steps."""

    def __init__(self, config: UrEmulatorConfig) -> None:
        self.config = config
        self.dt: float = 1 / config.hz
        self.arm: EmulatedArm = EmulatedArm(config)
        self.registers = Registers()
        self.program: _ControlProgram | _ScriptProgram | None = None
        self.safety = SafetyMode.NORMAL
        self.robot_mode = RobotMode.RUNNING
        self.runtime = Runtime.STOPPED
        self.ik_fails = False
        self.time = 0.0
        self.remote = config.remote
        self.targets: deque[dict[str, Any]] = deque(maxlen=MAX_TARGETS)
        self.watchdog_stops = self.program_stops = self.programs = 0
        self._uploaded: tuple[float, str] | None = None  # start time s, program
        self._resumed: list[MoveOrder] = []
        self._watchdog: tuple[float, int, float] | None = None  # timeout s, register, start s
        self._stopped_at = -1e9
        self.publish()

    def tick(self, host: float) -> None:
        """Advances one control step at a host time, s."""
        self.time += self.dt
        if self._watchdog is not None:
            timeout, register, since = self._watchdog
            if host - max(self.registers.written[register], since) > timeout:
                self.watchdog_stops += 1
                self.stop_program()
        if self._uploaded is not None and self.time >= self._uploaded[0]:
            text, self._uploaded = self._uploaded[1], None
            self.programs += 1
            self.runtime = Runtime.PLAYING
            own = "def rtde_control" in text  # ur_rtde's control program
            self.program = _ControlProgram(self, text) if own else _ScriptProgram(self, text)
        slider = self.registers.inputs.pop("speed_slider_fraction", None)
        if slider is not None and self.registers.inputs.get("speed_slider_mask", (0,))[0]:
            self.arm.scale = min(1.0, max(0.0, slider[0]))
        try:
            if self.program is not None and self.runtime is Runtime.PLAYING and not self.program.step():
                self.stop_program()
        except Unreachable:
            self.stop_program()
        try:
            self.arm.step(self.dt)
        except Unreachable:  # during a move: a real arm would make a safety stop
            self.protective_stop()
        pushed = math.hypot(*self.arm.force[:3]) > self.config.protective_force
        if pushed and self.safety is SafetyMode.NORMAL:
            self.protective_stop()
        self.publish()

    def watch(self, frequency: float, register: int) -> None:
        """Stops the program when a register is written less often than `frequency`, Hz; 0 turns this off."""
        since = self.registers.written[register]
        self._watchdog = (1 / frequency, register, since) if frequency > 0 else None

    def upload(self, text: str) -> None:
        """Uploads a program, which replaces the running one."""
        self.stop_program()
        if self.safety is SafetyMode.NORMAL and self.robot_mode is RobotMode.RUNNING:
            self._uploaded = (self.time + self.config.starting, text)

    def stop_program(self) -> None:
        """Ends the program and stops the arm."""
        if self.program is not None:
            self.program_stops += 1
        self.program, self._uploaded, self._watchdog = None, None, None
        self._resumed = []
        self.runtime = Runtime.STOPPED
        self.arm.halt(self.config.halt)

    def protective_stop(self) -> None:
        """Stops the arm and pauses the program until `unlock`."""
        self._stop(SafetyMode.PROTECTIVE_STOP)

    def safeguard_stop(self) -> None:
        """Stops the arm; motion resumes when the safeguard is closed."""
        remaining = self.arm.remaining
        self._stop(SafetyMode.SAFEGUARD_STOP)
        self._resumed = remaining

    def emergency_stop(self) -> None:
        """Stops the arm and cuts its power; ends the program."""
        self._stop(SafetyMode.ROBOT_EMERGENCY_STOP)
        self.stop_program()
        self.arm.halt(self.config.brake)
        self.robot_mode = RobotMode.POWER_OFF

    def _stop(self, mode: SafetyMode) -> None:
        self.safety = mode
        self._stopped_at = self.time
        if self.runtime is Runtime.PLAYING:
            self.runtime = Runtime.PAUSED
        self._watchdog, self._uploaded = None, None
        self.arm.halt(self.config.brake)

    def unlock(self) -> bool:
        """Ends a protective stop; False before `unlock_wait` has passed."""
        if self.safety is SafetyMode.PROTECTIVE_STOP:
            if self.time - self._stopped_at < self.config.unlock_wait:
                return False
            self.safety = SafetyMode.NORMAL
        return True

    def clear(self) -> None:
        """Clears the cause of a stop. A safeguarded program resumes; emergency stops leave power off."""
        if self.safety is SafetyMode.SAFEGUARD_STOP and self.runtime is Runtime.PAUSED:
            self.runtime = Runtime.PLAYING
            self.arm.order(self._resumed)
            self._resumed = []
        self.safety = SafetyMode.NORMAL

    def power(self, mode: RobotMode) -> None:
        """Sets the power mode."""
        if self.safety is SafetyMode.NORMAL:
            self.robot_mode = mode
            if mode is not RobotMode.RUNNING:
                self.stop_program()

    def solve(self, tcp: Vector6) -> Vector6:
        """Joints [6] (rad) for a tool pose [6] (m, rotation vector rad). Raises `Unreachable`."""
        if self.ik_fails:
            raise Unreachable("requested failure")
        return self.arm.solve(tcp)

    def solvable(self, tcp: Vector6) -> bool:
        try:
            self.solve(tcp)
        except Unreachable:
            return False
        return True

    def record_target(self, kind: str, order: MoveOrder) -> None:
        """Records a command for the fault port's `state`."""
        entry: dict[str, Any] = {"time": self.time, "do": kind, "order": type(order).__name__}
        if isinstance(order, MoveL):
            entry |= order._asdict() | {"goal": list(order.goal)}
        self.targets.append(entry)

    def publish(self) -> None:
        """Updates the published fields."""
        fields, state = self.registers.fields, self.arm.state
        playing = self.runtime is Runtime.PLAYING
        powered = self.robot_mode is not RobotMode.POWER_OFF
        fields["timestamp"] = (self.time,)
        fields["actual_TCP_pose"] = fields["target_TCP_pose"] = state.tcp
        fields["actual_TCP_speed"] = fields["target_TCP_speed"] = state.speed
        fields["actual_q"] = fields["target_q"] = state.joints
        fields["actual_qd"] = fields["target_qd"] = state.joint_speed
        fields["actual_TCP_force"] = fields["ft_raw_wrench"] = self.arm.force
        fields["runtime_state"] = (self.runtime,)
        fields["robot_mode"] = (self.robot_mode,)
        fields["safety_mode"] = (self.safety,)
        fields["safety_status_bits"] = (SAFETY_BITS[self.safety],)
        bits = POWER_ON * powered | PROGRAM_RUNNING * playing
        fields["robot_status_bits"] = (bits,)
        fields["target_speed_fraction"] = (self.arm.scale,)


class _ControlCommand(IntEnum):
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

READY, DONE = 1, 2
RUNNING_BIT = 1 << 15

_OFFSET = re.compile(r"# int register offset\n\s*(\d+)")


class _ControlProgram:
    """The running control program of ur_rtde, emulated at its registers.

    The client writes the number of a command into integer register 0 and its arguments into others. The
    program writes 1 to output register 0 when it is ready and 2 when it has executed a command; then the
    client writes 0. Output register 2 describes the newest asynchronous operation: its number and whether it
    is under way. Source: the interface described by ur_rtde 1.6.5 (its control script and documentation).

    The commands of our driver are executed. Any other ends the program, as an error in a script does on a
    controller: the function of ur_rtde returns False or raises an error, and the emulator names it on
    standard error. Functions that do not wait for an answer (`servoJ`, `speedL`, ...) return True the first
    time, but end the program too.
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
        if command == _ControlCommand.NONE:
            self._executing = False
            self._answer(READY)
        elif not self._executing:
            self._executing = True
            if command == _ControlCommand.END:
                return False
            if command not in set(_ControlCommand):
                refusal = f"{REFUSED.get(command, 'an unknown function')} (command {command}) is not emulated"
                refusal += f" and ends the control program; emulated are {EMULATED}"
                print(f"emulated controller: {refusal}", file=sys.stderr, flush=True)
                return False
            self._execute(command)
            if not self._waiting:
                self._answer(DONE)
        return True

    def _execute(self, command: int) -> None:
        controller, first = self._controller, self._registers.doubles[self._offset]
        vector = vector6(self._registers.doubles[self._offset : self._offset + 6])
        if command == _ControlCommand.MOVE_L:
            controller.solve(vector)
            speed, acceleration = self._registers.doubles[self._offset + 6 : self._offset + 8]
            self._order("movel", MoveL(vector, speed, acceleration))
        elif command == _ControlCommand.STOP_L:
            self._order("stop", StopL(first))
        elif command == _ControlCommand.SET_TCP:
            controller.arm.set_tool(vector)
        elif command == _ControlCommand.SET_WATCHDOG:
            controller.watch(first, self._offset)
        elif command == _ControlCommand.POSE_WITHIN_SAFETY_LIMITS:
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


class _ScriptProgram:
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
