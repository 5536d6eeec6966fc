"""Safety of the controller: protective, safeguard and emergency stops."""

from __future__ import annotations

import pytest

from robot.emulators.ur10.controller import RobotMode, Runtime, SafetyMode
from tests.robot.emulators.ur10.controller_bench import THERE, Bench


def test_a_protective_stop_can_be_unlocked_after_five_seconds() -> None:
    bench = Bench()
    assert bench.command(3, (*THERE, 0.1, 1.0), asynchronous=1)
    bench.ticks(0.3)
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
    assert bench.command(3, (*THERE, 0.1, 1.0))


def test_a_move_resumes_when_the_safeguard_is_closed() -> None:
    bench = Bench()
    assert bench.command(3, (*THERE, 0.1, 1.0), asynchronous=1)
    bench.ticks(0.3)
    bench.controller.safeguard_stop()
    bench.ticks(1.0)
    assert not bench.controller.arm.moving
    stood = bench.controller.arm.state.tcp[1]
    assert 0 < stood < 0.1
    bench.controller.clear()
    bench.ticks(3.0)
    assert bench.controller.arm.state.tcp[1] == pytest.approx(0.1)


def test_an_emergency_stop_cuts_the_power_until_it_is_switched_on() -> None:
    bench = Bench()
    assert bench.command(3, (*THERE, 0.1, 1.0), asynchronous=1)
    bench.ticks(0.3)
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
    assert bench.command(3, (*THERE, 0.1, 1.0))


def test_excessive_force_causes_a_protective_stop() -> None:
    bench = Bench(walls=[{"axis": "y", "at": 0.02, "stiffness": 5000.0}], protective_force=100.0)
    bench.command(3, (*THERE, 0.1, 1.0), asynchronous=1)
    bench.ticks(2.0)
    assert bench.controller.safety is SafetyMode.PROTECTIVE_STOP
    assert 0.02 < bench.controller.arm.penetration_max < 0.03
