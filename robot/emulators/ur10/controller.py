"""The emulated controller without sockets: arm, program, safety, registers."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import IntEnum, IntFlag
from typing import Any, Protocol

from robot.emulators.ur10.emulated_arm import EmulatedArm, force_magnitude
from robot.emulators.ur10.emulator_config import UrEmulatorConfig
from robot.emulators.ur10.kinematics import Vector6
from robot.emulators.ur10.motion import MoveL, MoveOrder, Unreachable
from robot.emulators.ur10.registers import Registers

MAX_TARGETS = 10_000  # orders kept for the fault request "state"


class Program(Protocol):
    """An uploaded program while it runs."""

    def step(self) -> bool:
        """Runs one control step; False when the program has ended."""
        ...


class EmulatedController:
    """An emulated controller. `tick` runs a control step; clients call the other methods between steps."""

    def __init__(
        self, config: UrEmulatorConfig, load_program: Callable[[EmulatedController, str], Program]
    ) -> None:
        self.config = config
        self._load_program = load_program
        self.dt: float = 1 / config.hz
        self.arm: EmulatedArm = EmulatedArm(config)
        self.registers = Registers()
        self.program: Program | None = None
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
            self._run(self._uploaded[1])
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
        if (
            force_magnitude(self.arm.force) > self.config.protective_force
            and self.safety is SafetyMode.NORMAL
        ):
            self.protective_stop()
        self.publish()

    def watch(self, frequency: float, register: int) -> None:
        """Stops the program when a register is written less often than `frequency`, Hz; 0 turns this off."""
        self._watchdog = (
            (1 / frequency, register, self.registers.written[register]) if frequency > 0 else None
        )

    def upload(self, text: str) -> None:
        """Uploads a program, which replaces the running one."""
        self.stop_program()
        if self.safety is SafetyMode.NORMAL and self.robot_mode is RobotMode.RUNNING:
            self._uploaded = (self.time + self.config.starting, text)

    def _run(self, text: str) -> None:
        self._uploaded = None
        self.programs += 1
        self.runtime = Runtime.PLAYING
        self.program = self._load_program(self, text)

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
        return self.arm.model.backward(tcp, self.arm.state.joints)

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
        fields["safety_status_bits"] = (BITS[self.safety],)
        bits = StatusBits.POWER_ON * powered | StatusBits.PROGRAM_RUNNING * playing
        fields["robot_status_bits"] = (bits,)
        fields["target_speed_fraction"] = (self.arm.scale,)


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


class SafetyBits(IntFlag):
    """`safety_status_bits`."""

    NORMAL = 1 << 0
    PROTECTIVE_STOPPED = 1 << 2
    SAFEGUARD_STOPPED = 1 << 4
    ROBOT_EMERGENCY_STOPPED = 1 << 6
    EMERGENCY_STOPPED = 1 << 7
    STOPPED_DUE_TO_SAFETY = 1 << 10


class StatusBits(IntFlag):
    """`robot_status_bits`."""

    POWER_ON = 1 << 0
    PROGRAM_RUNNING = 1 << 1


BITS = {
    SafetyMode.NORMAL: SafetyBits.NORMAL,
    SafetyMode.PROTECTIVE_STOP: SafetyBits.PROTECTIVE_STOPPED | SafetyBits.STOPPED_DUE_TO_SAFETY,
    SafetyMode.SAFEGUARD_STOP: SafetyBits.SAFEGUARD_STOPPED | SafetyBits.STOPPED_DUE_TO_SAFETY,
    SafetyMode.ROBOT_EMERGENCY_STOP: SafetyBits.ROBOT_EMERGENCY_STOPPED
    | SafetyBits.EMERGENCY_STOPPED
    | SafetyBits.STOPPED_DUE_TO_SAFETY,
}
