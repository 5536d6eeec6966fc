"""Recipes of RTDE clients: types, states, variables that belong to one client."""

from __future__ import annotations

import struct

from robot.drivers.ur10 import rtde_protocol
from robot.emulators.ur10.controller import EmulatedController
from robot.emulators.ur10.emulator_config import UrEmulatorConfig
from robot.emulators.ur10.server import Claims, RtdeSession
from tests.robot.emulators.ur10.controller_bench import HERE, Bench


def names(variables: list[str], frequency: float | None = None) -> bytes:
    listed = ",".join(variables).encode()
    return listed if frequency is None else struct.pack(">d", frequency) + listed


def reply(session: RtdeSession, kind: int, body: bytes = b"") -> bytes:
    ((got, answer),) = rtde_protocol.PackageSplitter().feed(
        session.receive(rtde_protocol.pack_package(kind, body), 0.0)
    )
    assert got == kind
    return answer


def test_output_recipes_return_types_and_define_states() -> None:
    bench = Bench()
    session = RtdeSession(bench.controller, Claims())
    assert reply(session, rtde_protocol.PROTOCOL, b"\0\2") == b"\1"
    assert reply(session, rtde_protocol.PROTOCOL, b"\0\1") == b"\0"
    assert reply(session, rtde_protocol.CONTROLLER) == struct.pack(">4I", 3, 15, 8, 0)
    wanted = ["timestamp", "actual_TCP_pose", "robot_mode", "output_int_register_0"]
    assert reply(session, rtde_protocol.OUTPUTS, names([*wanted, "weather"], 125.0))[1:].endswith(
        b"NOT_FOUND"
    )
    assert reply(session, rtde_protocol.OUTPUTS, names(wanted, 62.5)) == b"\1DOUBLE,VECTOR6D,INT32,INT32"
    assert session.every == 2
    assert reply(session, rtde_protocol.START) == b"\1"
    ((_, state),) = rtde_protocol.PackageSplitter().feed(session.state({}))
    recipe, time, *rest = struct.unpack(">Bd6dii", state)
    assert recipe == 1
    assert time == bench.controller.time
    assert tuple(rest) == (*HERE, 7, 1)


def test_an_input_variable_belongs_to_one_client() -> None:
    claims = Claims()
    controller = EmulatedController(UrEmulatorConfig())
    first, second = RtdeSession(controller, claims), RtdeSession(controller, claims)
    registers = ["input_int_register_0", "input_double_register_3"]
    assert reply(first, rtde_protocol.INPUTS, names(registers)) == b"\1INT32,DOUBLE"
    assert reply(first, rtde_protocol.INPUTS, names(registers[:1])) == b"\2INT32"
    assert reply(second, rtde_protocol.INPUTS, names(registers)) == b"\0IN_USE,IN_USE"
    first.receive(rtde_protocol.pack_package(rtde_protocol.DATA, struct.pack(">Bid", 1, 7, 0.5)), 3.0)
    first.receive(
        rtde_protocol.pack_package(rtde_protocol.DATA, struct.pack(">Bi", 1, 8)), 4.0
    )  # too short for its recipe
    assert (controller.registers.ints[0], controller.registers.doubles[3]) == (7, 0.5)
    assert controller.registers.written[0] == 3.0
    assert first.ignored == 1
    first.close()
    assert reply(second, rtde_protocol.INPUTS, names(registers)) == b"\1INT32,DOUBLE"
    claims.held_by_fieldbus = True
    assert reply(RtdeSession(controller, claims), rtde_protocol.INPUTS, names(registers[:1])) == b"\0IN_USE"
