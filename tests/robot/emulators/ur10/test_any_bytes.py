"""The controller's sessions with any bytes, any packages, and streams split anywhere."""

from __future__ import annotations

import contextlib

from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.ur10 import rtde_protocol
from robot.drivers.ur10.rtde_protocol import DATA, INPUTS, OUTPUTS, PROTOCOL, START, TEXT
from robot.emulators.ur10.controller import EmulatedController
from robot.emulators.ur10.emulator_config import UrEmulatorConfig
from robot.emulators.ur10.server import (
    Claims,
    DashboardSession,
    RtdeSession,
    ScriptSession,
)


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


@given(kind=st.sampled_from([PROTOCOL, OUTPUTS, INPUTS, START, DATA, TEXT]), body=st.binary(max_size=40))
def test_any_package_body_leaves_the_session_working(kind: int, body: bytes) -> None:
    session = RtdeSession(EmulatedController(UrEmulatorConfig()), Claims())
    with contextlib.suppress(ValueError):
        session.receive(rtde_protocol.pack_package(kind, body), 0.0)
    session.state({})


@given(data=st.binary(max_size=300), cut=st.integers(0, 300))
def test_packages_do_not_depend_on_how_the_stream_is_split(data: bytes, cut: int) -> None:
    stream = b"".join(rtde_protocol.pack_package(byte, data[:byte]) for byte in data[:20])
    whole, parts = rtde_protocol.PackageSplitter(), rtde_protocol.PackageSplitter()
    assert list(whole.feed(stream)) == [*parts.feed(stream[:cut]), *parts.feed(stream[cut:])]
