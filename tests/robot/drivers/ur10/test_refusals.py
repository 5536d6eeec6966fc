"""Reasons not to arm the arm: each is reported with its cure, and the arm does not move."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import pytest

from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.dashboard import PORT, Dashboard, DashboardSilent
from robot.drivers.ur10.driver_config import ArmConfig, BoxConfig
from robot.drivers.ur10.safety import StartupRefused, check_controller
from tests.helpers.live import Faults, moves, until
from tests.robot.drivers.ur10.conftest import HOME, settings

GOOD = {
    "PolyscopeVersion": "URSoftware 5.11.0.108249 (Apr 01 2021)",
    "robotmode": "Robotmode: RUNNING",
    "safetymode": "Safetymode: NORMAL",
    "is in remote control": "true",
    "running": "Program running: false",
    "stop": "Stopped",
}


@contextmanager
def serve_answers(host: str, answers: dict[str, str]) -> Iterator[None]:
    """A dashboard server with these answers; it does not answer other commands."""
    with socket.create_server((host, PORT)) as server:

        def serve() -> None:
            with suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    with connection, suppress(OSError):
                        connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
                        for line in connection.makefile("r"):
                            if line.strip() in answers:
                                connection.sendall(answers[line.strip()].encode() + b"\n")

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield
        server.shutdown(socket.SHUT_RDWR)
        thread.join(60)


@pytest.fixture
def elsewhere(loopback: str) -> str:
    """An address at which no emulator listens."""
    return loopback.replace("127.0.0.", "127.0.1.")


@pytest.mark.parametrize(
    ("changed", "found"),
    [
        ({"PolyscopeVersion": "URSoftware 3.3.4.310 (May 09 2017)"}, "PolyScope 3.3"),
        ({"PolyscopeVersion": "what?"}, "PolyScope 0.0"),
        ({"robotmode": "Robotmode: POWER_OFF"}, "robot mode POWER_OFF"),
        ({"safetymode": "Safetymode: PROTECTIVE_STOP"}, "safety mode PROTECTIVE_STOP"),
        ({"is in remote control": "false"}, "under local control"),
        ({"running": "Program running: true"}, "a program runs"),
    ],
)
def test_start_is_refused(elsewhere: str, changed: dict[str, str], found: str) -> None:
    with serve_answers(elsewhere, GOOD | changed):
        with pytest.raises(StartupRefused, match=found) as refusal:
            check_controller(ArmConfig(host=elsewhere))
        assert refusal.value.cure or refusal.value.expected


def test_controllers_of_all_versions_pass(elsewhere: str) -> None:
    with serve_answers(elsewhere, GOOD):
        assert check_controller(ArmConfig(host=elsewhere)).remote is True
    old = GOOD | {"PolyscopeVersion": "URSoftware 3.4.5.100 (Jan 01 2018)"}
    del old["is in remote control"]  # a CB3 lacks this command
    with serve_answers(elsewhere, old):
        controller = check_controller(ArmConfig(host=elsewhere))
        assert controller.version == (3, 4)
        assert controller.remote is None


def test_a_silent_dashboard_times_out(elsewhere: str) -> None:
    with pytest.raises(StartupRefused, match="no dashboard server answers"):
        check_controller(ArmConfig(host=elsewhere))
    assert dashboard.stop_program(elsewhere) == ""
    with (
        serve_answers(elsewhere, {}),
        Dashboard(elsewhere, timeout=0.2) as connection,
        pytest.raises(DashboardSilent, match="robotmode"),
    ):
        connection.ask("robotmode")


def check_refusal(controller: Faults, **others: Any) -> StartupRefused:
    """Checks that an arm does not start, move or leave a process; returns the refusal."""
    before = len(controller.state()["targets"])
    with Arm(settings(controller.host, **others)) as arm:
        with pytest.raises(StartupRefused) as refusal:
            arm.start()
        assert arm.process is None
        assert arm.fault is None
    assert moves(controller, before) == []
    np.testing.assert_array_equal(controller.state()["tcp"], HOME)
    return refusal.value


def test_registers_in_use(controller: Faults) -> None:
    controller(do="registers")
    assert check_refusal(controller).found == "registers in use"


def test_a_slow_stream(controller: Faults) -> None:
    controller(do="rate", hz=80)
    found = re.fullmatch(r"stream at (\d+) of 125 Hz", check_refusal(controller, connect=5.0).found)
    assert found is not None
    assert int(found[1]) < 112  # 0.9 of the nominal rate; lower still on a busy machine


def test_start_outside_the_box(controller: Faults) -> None:
    refusal = check_refusal(controller, box=BoxConfig(low=tuple(HOME[:3] + 0.1), high=tuple(HOME[:3] + 0.2)))
    assert "outside the box" in str(refusal)


def test_a_controller_that_does_not_answer_on_its_other_ports(elsewhere: str) -> None:
    with serve_answers(elsewhere, GOOD), Arm(ArmConfig(host=elsewhere)) as arm, pytest.raises(StartupRefused):
        arm.start()


def test_an_arm_that_was_not_started_refuses_and_closes(loopback: str) -> None:
    from robot.drivers.ur10.safety import TargetRefused

    with Arm(ArmConfig(host=loopback)) as arm:
        with pytest.raises(TargetRefused, match="not armed"):
            arm.move(HOME)
        assert arm.latest() is None
        assert not arm.still()
        assert not arm.arrived()
        assert arm.age() == float("inf")


def test_a_second_session_is_refused_and_the_first_continues(controller: Faults) -> None:
    with Arm(settings(controller.host)) as first:
        first.start()
        refusal = check_refusal(controller)
        assert refusal.found == "a program runs on the controller"
        first.move(HOME + [0.003, 0, 0, 0, 0, 0])
        until(first.arrived, "arrival")
        assert first.fault is None
