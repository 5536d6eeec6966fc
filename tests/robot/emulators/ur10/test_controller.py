"""The emulated controller: commands, safety stops, the dashboard, sessions of clients."""

from __future__ import annotations

import contextlib
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.ur10 import rtde_protocol as rtde
from robot.emulators.ur10.controller import EmulatedController, RobotMode, Runtime, SafetyMode
from robot.emulators.ur10.emulator_config import UrEmulatorConfig
from robot.emulators.ur10.server import Claims, DashboardSession, RtdeSession, ScriptSession

PROGRAM = b"def rtde_control():\n    global reg_offset_int = # int register offset\n0\nend\n"
HERE = (0.6, 0.0, 0.3, math.pi, 0.0, 0.0)
THERE = (0.6, 0.1, 0.3, math.pi, 0.0, 0.0)
RUNNING = 1 << 15


class Bench:
    """A controller, its clock, and a client that writes registers as the library does."""

    def __init__(self, **settings: object) -> None:
        self.controller = EmulatedController(UrEmulatorConfig.model_validate(settings))
        self.host = 0.0
        self.script = ScriptSession(self.controller)
        self.dashboard = DashboardSession(self.controller)
        self.upload()

    def upload(self) -> None:
        self.script.receive(PROGRAM, self.host)
        self.ticks(0.1)

    def ticks(self, seconds: float) -> None:
        for _ in range(round(seconds / self.controller.dt)):
            self.host += self.controller.dt
            self.controller.tick(self.host)

    def write(self, command: int, doubles: tuple[float, ...] = (), asynchronous: int = 0) -> None:
        registers = self.controller.registers
        for index, number in enumerate(doubles):
            registers.write(f"input_double_register_{index}", (number,), self.host)
        registers.write("input_int_register_1", (asynchronous,), self.host)
        registers.write("input_int_register_0", (command,), self.host)

    def out(self, index: int) -> int:
        return int(self.controller.registers.fields[f"output_int_register_{index}"][0])

    def command(
        self, number: int, doubles: tuple[float, ...] = (), asynchronous: int = 0, wait: float = 30
    ) -> bool:
        """Sends a command and clears it when it is done; False without an answer within `wait` s."""
        assert self.out(0) == 1
        self.write(number, doubles, asynchronous)
        for _ in range(round(wait / self.controller.dt)):
            self.ticks(self.controller.dt)
            if self.out(0) == 2:
                self.write(0)
                self.ticks(0.02)
                return True
            if self.controller.runtime is not Runtime.PLAYING:
                self.write(0)
                return False
        return False

    def move(self, pose: tuple[float, ...], speed: float = 0.1, asynchronous: int = 0) -> bool:
        """Sends a linear move; see `command`."""
        return self.command(3, (*pose, speed, 1.0), asynchronous)

    @property
    def tcp(self) -> tuple[float, ...]:
        return self.controller.arm.state.tcp

    def ask(self, line: str) -> str:
        return self.dashboard.receive(line.encode() + b"\n", self.host).decode().strip()


def moving(seconds: float = 0.3) -> Bench:
    """A controller whose arm has moved to `THERE` for some seconds, of one."""
    bench = Bench()
    assert bench.move(THERE, asynchronous=1)
    bench.ticks(seconds)
    return bench


def test_a_command_is_executed_once_until_its_register_is_cleared() -> None:
    bench = Bench()
    assert bench.out(0) == 1
    assert bench.move(THERE, speed=0.2)
    assert bench.tcp[:3] == pytest.approx(THERE[:3])
    bench.write(3, (*HERE, 0.2, 1.0))
    bench.ticks(5.0)  # the register is not cleared: executed once, and 2 stays
    assert bench.out(0) == 2
    assert len([t for t in bench.controller.targets if t["do"] == "movel"]) == 2


def test_operations_are_numbered_in_the_progress_register() -> None:
    bench = Bench()
    before = bench.out(2)
    assert not before & RUNNING
    for number, place in enumerate((THERE, HERE), 1):  # the second during the first move
        assert bench.move(place, asynchronous=1)
        assert bench.out(2) & RUNNING
        assert bench.out(2) >> 24 == (before >> 24) + number
    bench.ticks(5.0)
    assert not bench.out(2) & RUNNING
    assert bench.out(2) >> 24 == (before >> 24) + 2
    assert bench.tcp[:3] == pytest.approx(HERE[:3], abs=1e-9)


def test_an_asynchronous_stop_ends_a_move_and_is_an_operation_itself() -> None:
    bench = moving()
    operation = bench.out(2) >> 24
    assert bench.command(33, (1.0,), asynchronous=1)
    bench.ticks(0.5)
    assert not bench.controller.arm.moving
    assert bench.tcp[1] < 0.09
    assert bench.out(2) >> 24 == operation + 1
    assert not bench.out(2) & RUNNING


def test_a_synchronous_move_ends_an_asynchronous_one() -> None:
    bench = moving(0.1)
    bench.write(3, (*HERE, 0.1, 1.0))
    bench.ticks(0.05)
    assert bench.controller.arm.moving
    assert not bench.out(2) & RUNNING


@given(frequency=st.sampled_from([5.0, 10.0, 20.0]), kicks=st.integers(2, 12))
def test_the_watchdog_stops_the_arm_only_when_it_is_not_reset(frequency: float, kicks: int) -> None:
    bench = Bench()
    assert bench.command(35, (frequency,))
    bench.write(3, (*THERE, 0.005, 1.0), asynchronous=1)
    bench.ticks(0.008)
    for _ in range(kicks):
        bench.write(0)
        bench.ticks(0.8 / frequency)
        assert bench.controller.runtime is Runtime.PLAYING
        assert bench.controller.arm.moving
    bench.ticks(0.2 / frequency + 0.1)
    assert bench.controller.watchdog_stops == 1
    assert bench.controller.runtime is Runtime.STOPPED
    assert not bench.controller.arm.moving


@pytest.mark.parametrize(("command", "name"), [(1, "moveJ"), (11, "servoJ"), (200, "an unknown function")])
def test_a_command_that_is_not_emulated_ends_the_program(command: int, name: str, capsys) -> None:
    bench = moving(0.1)
    assert not bench.command(command, HERE)
    assert bench.controller.runtime is Runtime.STOPPED
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{name} (command {command})" in line
    assert "moveL, " in line
    bench.ticks(0.5)
    assert not bench.controller.arm.moving
    bench.upload()
    assert bench.move(HERE)


def test_an_unreachable_target_ends_the_program() -> None:
    bench = Bench()
    assert not bench.move((3.0, *THERE[1:]))
    assert bench.controller.runtime is Runtime.STOPPED
    bench.upload()
    assert not bench.command(3, (math.nan,) * 8)
    bench.upload()
    bench.controller.ik_fails = True
    assert not bench.move(THERE)
    assert bench.tcp == HERE


def test_reachable_poses_are_within_safety_limits() -> None:
    bench = Bench()
    for pose, fails, within in ((THERE, False, 1), ((3.0, *THERE[1:]), False, 0), (THERE, True, 0)):
        bench.controller.ik_fails = fails
        assert bench.command(36, pose)
        assert bench.out(1) == within


def test_the_tool_centre_point_is_set_relative_to_the_flange() -> None:
    bench = Bench()
    assert bench.command(29, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
    assert bench.tcp[:3] == pytest.approx((*HERE[:2], HERE[2] - 0.1))


def test_the_speed_slider_can_be_set_by_register_and_by_hand() -> None:
    bench = Bench()
    for name, value in (("speed_slider_mask", 1), ("speed_slider_fraction", 0.5)):
        bench.controller.registers.write(name, (value,), 0.0)
    bench.ticks(0.1)
    assert bench.controller.arm.scale == 0.5
    bench.controller.arm.scale = 0.2  # by hand
    bench.ticks(0.1)
    assert bench.controller.registers.fields["target_speed_fraction"] == (0.2,)


def test_a_protective_stop_can_be_unlocked_after_five_seconds() -> None:
    bench = moving()
    bench.controller.protective_stop()
    bench.ticks(0.3)
    assert not bench.controller.arm.moving
    assert bench.controller.safety is SafetyMode.PROTECTIVE_STOP
    assert bench.controller.registers.fields["safety_status_bits"] == (1 << 2 | 1 << 10,)
    assert bench.controller.runtime is Runtime.PAUSED
    assert bench.ask("unlock protective stop").startswith("Cannot")
    bench.upload()
    assert bench.controller.runtime is not Runtime.PLAYING  # a stop prevents a start
    bench.ticks(5.0)
    assert bench.ask("unlock protective stop") == "Protective stop releasing"
    bench.upload()
    assert bench.move(THERE)


def test_a_move_resumes_when_the_safeguard_is_closed() -> None:
    bench = moving()
    bench.controller.safeguard_stop()
    bench.ticks(1.0)
    assert not bench.controller.arm.moving
    assert 0 < bench.tcp[1] < 0.1
    bench.controller.clear()
    bench.ticks(3.0)
    assert bench.tcp[1] == pytest.approx(0.1)


def test_an_emergency_stop_cuts_the_power_until_it_is_switched_on() -> None:
    bench = moving()
    bench.controller.emergency_stop()
    bench.ticks(0.5)
    assert not bench.controller.arm.moving
    assert bench.controller.robot_mode is RobotMode.POWER_OFF
    assert bench.ask("safetymode") == "Safetymode: ROBOT_EMERGENCY_STOP"
    assert bench.controller.registers.fields["safety_status_bits"][0] & 1 << 7
    bench.controller.clear()
    bench.upload()
    assert bench.controller.runtime is Runtime.STOPPED
    assert bench.ask("power on") == "Powering on"
    assert bench.ask("brake release") == "Brake releasing"
    bench.upload()
    assert bench.move(THERE)


def test_excessive_force_causes_a_protective_stop() -> None:
    bench = Bench(walls=[{"axis": "y", "at": 0.02, "stiffness": 5000.0}], protective_force=100.0)
    bench.move(THERE, asynchronous=1)
    bench.ticks(2.0)
    assert bench.controller.safety is SafetyMode.PROTECTIVE_STOP
    assert 0.02 < bench.controller.arm.penetration_max < 0.03


@pytest.mark.parametrize(("polyscope", "modern"), [("3.4", False), ("5.5.1", False), ("5.6", True)])
def test_dashboard_commands_depend_on_the_version(polyscope: str, modern: bool) -> None:
    bench = Bench(polyscope=polyscope)
    assert polyscope in bench.ask("PolyscopeVersion")
    assert bench.ask("robotmode") == "Robotmode: RUNNING"
    assert bench.ask("running") == "Program running: true"
    assert bench.ask("stop") == "Stopped"
    assert bench.ask("running") == "Program running: false"
    assert (bench.ask("is in remote control") == "true") == modern
    assert bench.ask("get serial number").isdigit() == modern
    assert bench.ask("juggle") == "could not understand: 'juggle'"


def names(variables: list[str], frequency: float | None = None) -> bytes:
    listed = ",".join(variables).encode()
    return listed if frequency is None else struct.pack(">d", frequency) + listed


def reply(session: RtdeSession, kind: int, body: bytes = b"") -> bytes:
    ((got, answer),) = rtde.PackageSplitter().feed(session.receive(rtde.pack_package(kind, body), 0.0))
    assert got == kind
    return answer


def test_output_recipes_return_types_and_define_states() -> None:
    bench = Bench()
    session = RtdeSession(bench.controller, Claims())
    assert reply(session, rtde.PROTOCOL, b"\0\2") == b"\1"
    assert reply(session, rtde.PROTOCOL, b"\0\1") == b"\0"
    assert reply(session, rtde.CONTROLLER) == struct.pack(">4I", 3, 15, 8, 0)
    wanted = ["timestamp", "actual_TCP_pose", "robot_mode", "output_int_register_0"]
    assert reply(session, rtde.OUTPUTS, names([*wanted, "weather"], 125.0))[1:].endswith(b"NOT_FOUND")
    assert reply(session, rtde.OUTPUTS, names(wanted, 62.5)) == b"\1DOUBLE,VECTOR6D,INT32,INT32"
    assert session.every == 2
    assert reply(session, rtde.START) == b"\1"
    ((_, state),) = rtde.PackageSplitter().feed(session.state({}))
    assert struct.unpack(">Bd6dii", state) == (1, bench.controller.time, *HERE, 7, 1)


def test_an_input_variable_belongs_to_one_client() -> None:
    claims, controller = Claims(), EmulatedController(UrEmulatorConfig())
    first, second = RtdeSession(controller, claims), RtdeSession(controller, claims)
    registers = ["input_int_register_0", "input_double_register_3"]
    assert reply(first, rtde.INPUTS, names(registers)) == b"\1INT32,DOUBLE"
    assert reply(first, rtde.INPUTS, names(registers[:1])) == b"\2INT32"
    assert reply(second, rtde.INPUTS, names(registers)) == b"\0IN_USE,IN_USE"
    first.receive(rtde.pack_package(rtde.DATA, struct.pack(">Bid", 1, 7, 0.5)), 3.0)
    first.receive(rtde.pack_package(rtde.DATA, struct.pack(">Bi", 1, 8)), 4.0)  # too short for its recipe
    assert (controller.registers.ints[0], controller.registers.doubles[3]) == (7, 0.5)
    assert controller.registers.written[0] == 3.0
    assert first.ignored == 1
    first.close()
    assert reply(second, rtde.INPUTS, names(registers)) == b"\1INT32,DOUBLE"
    claims.held_by_fieldbus = True
    assert reply(RtdeSession(controller, claims), rtde.INPUTS, names(registers[:1])) == b"\0IN_USE"


@given(data=st.lists(st.binary(max_size=60), max_size=8))
def test_any_bytes_leave_the_sessions_working(data: list[bytes]) -> None:
    controller = EmulatedController(UrEmulatorConfig())
    for session in (
        RtdeSession(controller, Claims()),
        ScriptSession(controller),
        DashboardSession(controller),
    ):
        with contextlib.suppress(ValueError):  # ends this connection
            for piece in data:
                session.receive(piece, 0.0)
        controller.tick(0.0)


KINDS = [rtde.PROTOCOL, rtde.OUTPUTS, rtde.INPUTS, rtde.START, rtde.DATA, rtde.TEXT]


@given(kind=st.sampled_from(KINDS), body=st.binary(max_size=40))
def test_any_package_body_leaves_the_session_working(kind: int, body: bytes) -> None:
    session = RtdeSession(EmulatedController(UrEmulatorConfig()), Claims())
    with contextlib.suppress(ValueError):
        session.receive(rtde.pack_package(kind, body), 0.0)
    session.state({})


@given(data=st.binary(max_size=300), cut=st.integers(0, 300))
def test_packages_do_not_depend_on_how_the_stream_is_split(data: bytes, cut: int) -> None:
    stream = b"".join(rtde.pack_package(byte, data[:byte]) for byte in data[:20])
    whole, parts = rtde.PackageSplitter(), rtde.PackageSplitter()
    assert list(whole.feed(stream)) == [*parts.feed(stream[:cut]), *parts.feed(stream[cut:])]
