"""The real library against an emulated controller: whatever goes wrong has a name, and the arm stands."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.config import BoxConfig
from robot.drivers.ur10.dashboard import Dashboard
from robot.drivers.ur10.safety import TargetRefused
from tests.helpers.live import Faults, moves, until
from tests.robot.drivers.ur10.conftest import AWAY, HOME, settings


def under_way(arm: Arm, controller: Faults) -> None:
    """Send the arm off and wait until it is at full speed."""
    arm.move(AWAY)
    until(lambda: arm.fault or controller.state()["speed"][0] > 0.049, 2.0, "the arm moves")
    assert arm.fault is None


def ended(arm: Arm, controller: Faults, within: float = 0.5) -> SessionOutcome:
    """The fault's outcome, with the arm at a standstill at the emulator in time, and no way to move on."""
    fault = until(lambda: arm.fault, 3.0, "a fault")
    until(lambda: not controller.state()["moving"], within, "a standstill")
    place = controller.state()["tcp"]
    with pytest.raises(TargetRefused, match="does not move"):
        arm.move(HOME)
    time.sleep(0.1)
    if fault.outcome is not SessionOutcome.CONTACT:
        assert controller.state()["tcp"] == place
    return fault.outcome


def test_it_goes_where_it_is_sent_and_says_when_it_is_there(arm: Arm, controller: Faults) -> None:
    first = len(controller.state()["targets"])
    target = HOME + [0.01, 0.02, 0.0, 0.0, 0.0, 0.0]
    assert not arm.arrived()
    move = arm.move(target)
    assert not arm.arrived()
    began = time.monotonic()
    until(arm.arrived, move.most + 1, "arrival")
    assert time.monotonic() - began > 0.5 * move.seconds
    np.testing.assert_allclose(controller.state()["tcp"], target, atol=1e-9)
    (reached,) = moves(controller, first)
    np.testing.assert_array_equal(reached["goal"], target)
    assert reached["speed"] == arm.config.speed
    states = arm.states()
    assert (np.diff(states["counter"].astype(int)) == 1).all()
    assert (np.diff(states["host"]) > 0).all()
    # The library drops a state when two arrive together, which a busy machine makes happen.
    periods = np.diff(states["robot"]) * 125
    np.testing.assert_allclose(periods, np.round(periods), atol=1e-6)
    assert periods.min() > 0.5
    assert periods.mean() < 1.1
    assert len(arm.history) == len(states)
    assert len(arm.states(after=int(states["counter"][-1]) - 3)) >= 3
    # A second move to where it stands is one as well; a halt is not the end.
    arm.move(target)
    until(arm.arrived, 2.0, "arrival without a way")
    arm.move(AWAY)
    until(lambda: not arm.still(), 1.0)
    arm.halt("a test")
    until(lambda: not controller.state()["moving"], 0.3, "a standstill")
    assert not arm.arrived()
    arm.move(target)
    until(arm.arrived, 3.0)
    # A newer move replaces an older one.
    under_way(arm, controller)
    back = target + [0.03, 0.0, 0.0, 0.0, 0.0, 0.0]
    arm.move(back)
    until(arm.arrived, 4.0, "arrival")
    np.testing.assert_allclose(controller.state()["tcp"], back, atol=1e-9)
    assert arm.fault is None
    assert controller.state()["watchdog_stops"] == 0


@pytest.mark.parametrize(
    ("stop", "outcome"),
    [
        ("protective", SessionOutcome.PROTECTIVE_STOP),
        ("safeguard", SessionOutcome.SAFEGUARD_STOP),
        ("emergency", SessionOutcome.EMERGENCY_STOP),
    ],
)
def test_safety_stops(arm: Arm, controller: Faults, stop: str, outcome: SessionOutcome) -> None:
    under_way(arm, controller)
    controller(do=stop)
    assert ended(arm, controller) is outcome
    # States still come, so the pose can be read again; and when the stop is released nothing goes on.
    assert arm.age() < 0.05
    until(lambda: controller.state()["runtime"] == "STOPPED", 0.5, "the program is ended")
    place = controller.state()["tcp"]
    controller(do="clear")
    time.sleep(0.15)
    assert controller.state()["tcp"] == place
    np.testing.assert_allclose(arm.latest()["tcp"], place, atol=1e-9)


@pytest.mark.parametrize("seconds", [1.0, 3.0])
def test_a_stall(arm: Arm, controller: Faults, seconds: float) -> None:
    under_way(arm, controller)
    controller(do="stall", seconds=seconds)
    began = time.monotonic()
    assert ended(arm, controller) is SessionOutcome.ARM_STALE
    assert arm.fault.time - began < arm.config.stale + 0.3
    assert len(arm.history) > 10


@pytest.mark.parametrize("frame", ["malformed", "truncated", "huge"])
def test_frames_that_are_none(arm: Arm, controller: Faults, frame: str) -> None:
    under_way(arm, controller)
    controller(do=frame)
    assert ended(arm, controller) in (SessionOutcome.ARM_MALFORMED, SessionOutcome.ARM_STALE)
    assert np.isfinite(arm.history["tcp"]).all()


def test_a_state_that_is_not_finite(arm: Arm, controller: Faults) -> None:
    under_way(arm, controller)
    controller(do="nan")
    assert ended(arm, controller) is SessionOutcome.ARM_MALFORMED


def test_a_frozen_clock(arm: Arm, controller: Faults) -> None:
    under_way(arm, controller)
    controller(do="freeze")
    assert ended(arm, controller) is SessionOutcome.ARM_STALE


def test_the_controller_dies(arm: Arm, controller: Faults) -> None:
    under_way(arm, controller)
    controller.die()
    fault = until(lambda: arm.fault, 1.0, "a fault")
    assert fault.outcome in (SessionOutcome.ARM_GONE, SessionOutcome.ARM_STALE)


def test_somebody_ends_the_program(arm: Arm, controller: Faults) -> None:
    under_way(arm, controller)
    with Dashboard(controller.host) as dashboard:
        dashboard.stop()
    assert ended(arm, controller) is SessionOutcome.ARM_GONE


@pytest.mark.parametrize(
    ("number", "outcome"),
    [
        (signal.SIGSEGV, SessionOutcome.ARM_GONE),
        (signal.SIGKILL, SessionOutcome.ARM_GONE),
        (signal.SIGSTOP, SessionOutcome.ARM_STALE),
    ],
)
def test_the_arms_process_is_gone(arm: Arm, controller: Faults, number: int, outcome: SessionOutcome) -> None:
    under_way(arm, controller)
    os.kill(arm.pid, number)
    assert ended(arm, controller) is outcome
    if number == signal.SIGKILL:
        arm.respawn()
        assert arm.fault is None
        move = arm.move(HOME + [0.005, 0, 0, 0, 0, 0])
        until(arm.arrived, move.most + 1, "arrival after a respawn")


def test_a_halt_that_does_not_show_is_asked_for_the_second_way(controller: Faults) -> None:
    with Arm(settings(controller.host, stale=1.0)) as arm:
        arm.start()
        under_way(arm, controller)
        bites, ends = (controller.state()[name] for name in ("watchdog_stops", "program_stops"))
        os.kill(arm.pid, signal.SIGSTOP)
        arm.halt("nobody listens")
        until(lambda: not controller.state()["moving"], 0.45, "a standstill")
        assert controller.state()["program_stops"] == ends + 1
        assert controller.state()["watchdog_stops"] == bites
        os.kill(arm.pid, signal.SIGKILL)


def test_no_joints_for_a_target(arm: Arm, controller: Faults) -> None:
    first = len(controller.state()["targets"])
    controller(do="ik_fails")
    arm.move(AWAY)
    assert ended(arm, controller) is SessionOutcome.UNREACHABLE
    assert moves(controller, first) == []


def test_it_does_not_get_there(controller: Faults) -> None:
    with Arm(settings(controller.host, patience=0.3)) as arm:
        arm.start()
        arm.move(HOME + [0.01, 0, 0, 0, 0, 0])
        controller(do="slider", fraction=0.0)
        assert ended(arm, controller) is SessionOutcome.NOT_ARRIVED


def test_a_state_out_of_the_box(controller: Faults) -> None:
    config = settings(
        controller.host, box=BoxConfig(low=tuple(HOME[:3] - 0.2), high=tuple(HOME[:3] + [0.5, 0.2, 0.2]))
    )
    with Arm(config) as arm:
        arm.start()
        under_way(arm, controller)
        controller(do="place", tcp=(HOME + [0, 0.21, 0, 0, 0, 0]).tolist())
        assert ended(arm, controller) is SessionOutcome.OUT_OF_BOX


def test_a_wall_is_hit(controller: Faults) -> None:
    at = HOME[0] + 0.02
    with Arm(settings(controller.host, force_limit=20.0)) as arm:
        arm.start()
        controller(do="wall", x=at, stiffness=20_000)
        arm.move(AWAY)
        assert ended(arm, controller, within=3.0) is SessionOutcome.CONTACT
        assert controller.state()["penetration_max"] <= 0.003
        assert controller.state()["safety"] == "NORMAL"
        # Backed off the way it came: out of the wall, and no further than told.
        until(lambda: controller.state()["tcp"][0] < at - 0.006, 2.0, "it backs off")
        until(arm.still, 2.0)
        assert at - 0.0105 < controller.state()["tcp"][0]
        assert arm.fault.outcome is SessionOutcome.CONTACT


def test_somebody_else_finds_a_contact(arm: Arm, controller: Faults) -> None:
    under_way(arm, controller)
    time.sleep(0.2)
    arm.fail(SessionOutcome.CONTACT, "a whisker is bent too far")
    furthest = until(lambda: (not controller.state()["moving"]) and controller.state()["tcp"][0], 1.0)
    until(lambda: controller.state()["tcp"][0] < furthest - 0.009, 2.0, "it backs off")
    assert arm.fault.outcome is SessionOutcome.CONTACT
