"""Commands to the controller: executed once, numbered, stopped, watched, refused."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.emulators.ur10.controller import Runtime
from tests.robot.emulators.ur10.controller_bench import HERE, RUNNING, THERE, Bench


def test_a_command_is_executed_once_until_its_register_is_cleared() -> None:
    bench = Bench()
    assert bench.out(0) == 1
    assert bench.command(3, (*THERE, 0.2, 1.0))
    assert bench.controller.arm.state.tcp[:3] == pytest.approx(THERE[:3])
    bench.write(3, (*HERE, 0.2, 1.0))
    bench.ticks(5.0)  # the register is not cleared: executed once, and 2 stays
    assert bench.out(0) == 2
    assert len([t for t in bench.controller.targets if t["do"] == "movel"]) == 2


def test_operations_are_numbered_in_the_progress_register() -> None:
    bench = Bench()
    before = bench.out(2)
    assert not before & RUNNING
    assert bench.command(3, (*THERE, 0.1, 1.0), asynchronous=1)
    first = bench.out(2)
    assert first & RUNNING
    assert first >> 24 == (before >> 24) + 1
    assert bench.command(3, (*HERE, 0.1, 1.0), asynchronous=1)  # during the first move
    second = bench.out(2)
    assert second & RUNNING
    assert second >> 24 == (first >> 24) + 1
    bench.ticks(5.0)
    assert not bench.out(2) & RUNNING
    assert bench.out(2) >> 24 == second >> 24
    assert bench.controller.arm.state.tcp[:3] == pytest.approx(HERE[:3], abs=1e-9)


def test_an_asynchronous_stop_ends_a_move_and_is_an_operation_itself() -> None:
    bench = Bench()
    assert bench.command(3, (*THERE, 0.1, 1.0), asynchronous=1)
    operation = bench.out(2) >> 24
    bench.ticks(0.3)
    assert bench.command(33, (1.0,), asynchronous=1)
    bench.ticks(0.5)
    assert not bench.controller.arm.moving
    assert bench.controller.arm.state.tcp[1] < 0.09
    assert bench.out(2) >> 24 == operation + 1
    assert not bench.out(2) & RUNNING


def test_a_synchronous_move_ends_an_asynchronous_one() -> None:
    bench = Bench()
    assert bench.command(3, (*THERE, 0.1, 1.0), asynchronous=1)
    bench.ticks(0.1)
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
    bench = Bench()
    assert bench.command(3, (*THERE, 0.1, 1.0), asynchronous=1)
    bench.ticks(0.1)
    assert not bench.command(command, HERE)
    assert bench.controller.runtime is Runtime.STOPPED
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"emulated controller: {name} (command {command}) is not emulated")
    assert "moveL, " in line
    bench.ticks(0.5)
    assert not bench.controller.arm.moving
    bench.upload()
    assert bench.command(3, (*HERE, 0.1, 1.0))


def test_an_unreachable_target_ends_the_program() -> None:
    bench = Bench()
    assert not bench.command(3, (3.0, *THERE[1:], 0.1, 1.0))
    assert bench.controller.runtime is Runtime.STOPPED
    bench.upload()
    assert not bench.command(3, (math.nan,) * 8)
    bench.upload()
    bench.controller.ik_fails = True
    assert not bench.command(3, (*THERE, 0.1, 1.0))
    assert bench.controller.arm.state.tcp == HERE


def test_reachable_poses_are_within_safety_limits() -> None:
    bench = Bench()
    assert bench.command(36, THERE)
    assert bench.out(1) == 1
    assert bench.command(36, (3.0, *THERE[1:]))
    assert bench.out(1) == 0


def test_the_tool_centre_point_is_set_relative_to_the_flange() -> None:
    bench = Bench()
    assert bench.command(29, (0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
    assert bench.controller.arm.state.tcp[:3] == pytest.approx((*HERE[:2], HERE[2] - 0.1))


def test_the_speed_slider_can_be_set_by_register_and_by_hand() -> None:
    bench = Bench()
    for name, value in (("speed_slider_mask", 1), ("speed_slider_fraction", 0.5)):
        bench.controller.registers.write(name, (value,), 0.0)
    bench.ticks(0.1)
    assert bench.controller.arm.scale == 0.5
    bench.controller.arm.scale = 0.2  # by hand
    bench.ticks(0.1)
    assert bench.controller.registers.fields["target_speed_fraction"] == (0.2,)
