"""The arm by the real library on an emulated controller: moves, and an outcome for each fault."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.dashboard import Dashboard
from robot.drivers.ur10.driver_config import BoxConfig
from robot.drivers.ur10.safety import TargetRefused
from tests.helpers.live import PATIENCE, Faults, moves, until
from tests.robot.drivers.ur10.conftest import AWAY, HOME, settings


def start_move(arm: Arm, controller: Faults) -> None:
    """Starts a move and waits for full speed."""
    arm.move(AWAY)
    until(lambda: arm.fault or controller.state()["speed"][0] > 0.049, "the arm moves")
    assert arm.fault is None


def check_stop(arm: Arm, controller: Faults, within: float = PATIENCE) -> SessionOutcome:
    """Checks that a fault stops the arm before its target and that moves are refused; returns the outcome.

    Args:
        within: longest time from the fault to the standstill, s.
    """
    fault = until(lambda: arm.fault, "a fault")
    until(lambda: not controller.state()["moving"], "a standstill", within)
    place = controller.state()["tcp"]
    assert place[0] < AWAY[0] - 1e-3, "the arm reached its target"
    with pytest.raises(TargetRefused, match="does not move"):
        arm.move(HOME)
    time.sleep(0.1)
    if fault.outcome is not SessionOutcome.CONTACT:
        assert controller.state()["tcp"] == place
    return fault.outcome


TARGET = HOME + [0.01, 0.02, 0.0, 0.0, 0.0, 0.0]


def test_a_move_arrives(arm: Arm, controller: Faults) -> None:
    first = len(controller.state()["targets"])
    assert not arm.arrived()
    move = arm.move(TARGET)
    assert not arm.arrived()
    began = time.monotonic()
    until(arm.arrived, "arrival")
    assert time.monotonic() - began > 0.5 * move.seconds
    np.testing.assert_allclose(controller.state()["tcp"], TARGET, atol=1e-9)
    (reached,) = moves(controller, first)
    np.testing.assert_array_equal(reached["goal"], TARGET)
    assert reached["speed"] == arm.config.speed
    assert arm.fault is None


def test_states_are_in_order(arm: Arm, controller: Faults) -> None:
    until(lambda: len(arm.states()) > 100, "states")
    states = arm.states()
    assert (np.diff(states["counter"].astype(int)) == 1).all()
    assert (np.diff(states["host"]) > 0).all()
    # The library skips states that arrive together: periods are whole multiples.
    periods = np.diff(states["robot"]) * 125
    np.testing.assert_allclose(periods, np.round(periods), atol=1e-6)
    assert periods.min() > 0.5
    assert len(arm.history) >= len(states)
    assert len(arm.states(after=int(states["counter"][-1]) - 3)) >= 3


def test_a_move_to_the_present_pose_arrives(arm: Arm) -> None:
    arm.move(HOME)
    until(arm.arrived, "arrival without motion")


def test_a_move_after_a_halt(arm: Arm, controller: Faults) -> None:
    start_move(arm, controller)
    arm.halt()
    until(lambda: not controller.state()["moving"], "a standstill")
    assert controller.state()["tcp"][0] < AWAY[0] - 1e-3
    assert not arm.arrived()
    arm.move(TARGET)
    until(arm.arrived, "arrival")
    assert arm.fault is None


def test_a_newer_move_replaces_an_older(arm: Arm, controller: Faults) -> None:
    start_move(arm, controller)
    arm.move(TARGET)
    until(arm.arrived, "arrival")
    np.testing.assert_allclose(controller.state()["tcp"], TARGET, atol=1e-9)
    assert arm.fault is None
    assert controller.state()["watchdog_stops"] == 0


@pytest.mark.parametrize(
    ("stop", "outcome"),
    [
        ("protective", SessionOutcome.PROTECTIVE_STOP),
        ("safeguard", SessionOutcome.SAFEGUARD_STOP),
        pytest.param("emergency", SessionOutcome.EMERGENCY_STOP, marks=pytest.mark.soak),
    ],
)
def test_safety_stops(arm: Arm, controller: Faults, stop: str, outcome: SessionOutcome) -> None:
    start_move(arm, controller)
    controller(do=stop)
    assert check_stop(arm, controller) is outcome
    # States continue, so the pose stays known; after the release of the stop the program does not resume.
    until(lambda: arm.age() < 0.05, "a fresh state")
    until(lambda: controller.state()["runtime"] == "STOPPED", "the program is ended")
    place = controller.state()["tcp"]
    controller(do="clear")
    time.sleep(0.15)
    assert controller.state()["tcp"] == place
    np.testing.assert_allclose(arm.latest()["tcp"], place, atol=1e-9)


def test_a_stall(alert_arm: Arm, controller: Faults) -> None:
    start_move(alert_arm, controller)
    controller(do="stall", seconds=PATIENCE)
    assert check_stop(alert_arm, controller) is SessionOutcome.ARM_STALE
    assert len(alert_arm.history) > 10


@pytest.mark.soak
@pytest.mark.parametrize("seconds", [1.0, 3.0])
def test_a_stall_is_detected_in_time(controller: Faults, seconds: float) -> None:
    with Arm(settings(controller.host, stale=0.5)) as arm:
        arm.start()
        start_move(arm, controller)
        controller(do="stall", seconds=seconds)
        began = time.monotonic()
        assert check_stop(arm, controller, within=0.5) is SessionOutcome.ARM_STALE
        assert arm.fault is not None
        assert arm.fault.time - began < arm.config.stale + 0.3


@pytest.mark.parametrize(
    ("frame", "outcome"),
    [
        ("malformed", SessionOutcome.ARM_MALFORMED),
        ("truncated", SessionOutcome.ARM_MALFORMED),
        ("huge", SessionOutcome.ARM_STALE),
    ],
)
def test_invalid_frames(alert_arm: Arm, controller: Faults, frame: str, outcome: SessionOutcome) -> None:
    start_move(alert_arm, controller)
    controller(do=frame)
    assert check_stop(alert_arm, controller) is outcome
    assert np.isfinite(alert_arm.history["tcp"]).all()


def test_a_state_that_is_not_finite(arm: Arm, controller: Faults) -> None:
    start_move(arm, controller)
    controller(do="nan")
    assert check_stop(arm, controller) is SessionOutcome.ARM_MALFORMED


def test_a_frozen_clock(alert_arm: Arm, controller: Faults) -> None:
    start_move(alert_arm, controller)
    controller(do="freeze")
    assert check_stop(alert_arm, controller) is SessionOutcome.ARM_STALE


def test_the_controller_dies(arm: Arm, controller: Faults) -> None:
    start_move(arm, controller)
    controller.die()
    fault = until(lambda: arm.fault, "a fault")
    assert fault.outcome is SessionOutcome.ARM_GONE


def test_the_program_is_ended_on_the_controller(arm: Arm, controller: Faults) -> None:
    start_move(arm, controller)
    with Dashboard(controller.host) as dashboard:
        dashboard.stop()
    assert check_stop(arm, controller) is SessionOutcome.ARM_GONE


@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGKILL])
def test_the_rtde_process_ends(arm: Arm, controller: Faults, number: int) -> None:
    start_move(arm, controller)
    os.kill(arm.process.pid, number)
    assert check_stop(arm, controller) is SessionOutcome.ARM_GONE


def test_the_rtde_process_hangs(alert_arm: Arm, controller: Faults) -> None:
    start_move(alert_arm, controller)
    os.kill(alert_arm.process.pid, signal.SIGSTOP)
    assert check_stop(alert_arm, controller) is SessionOutcome.ARM_STALE


def test_a_stop_without_effect_is_repeated_by_the_dashboard(controller: Faults) -> None:
    with Arm(settings(controller.host)) as arm:
        arm.start()
        start_move(arm, controller)
        ends = controller.state()["program_stops"]
        os.kill(arm.process.pid, signal.SIGSTOP)
        arm.halt()
        until(lambda: not controller.state()["moving"], "a standstill")
        assert controller.state()["program_stops"] > ends
        assert controller.state()["tcp"][0] < AWAY[0] - 1e-3
        os.kill(arm.process.pid, signal.SIGKILL)


def test_a_target_without_joint_solution(arm: Arm, controller: Faults) -> None:
    first = len(controller.state()["targets"])
    controller(do="ik_fails")
    arm.move(AWAY)
    assert check_stop(arm, controller) is SessionOutcome.UNREACHABLE
    assert moves(controller, first) == []


def test_a_move_that_does_not_arrive(controller: Faults) -> None:
    with Arm(settings(controller.host, patience=0.3)) as arm:
        arm.start()
        arm.move(HOME + [0.01, 0, 0, 0, 0, 0])
        controller(do="slider", fraction=0.0)
        assert check_stop(arm, controller) is SessionOutcome.NOT_ARRIVED


def test_a_state_out_of_the_box(controller: Faults) -> None:
    config = settings(
        controller.host, box=BoxConfig(low=tuple(HOME[:3] - 0.2), high=tuple(HOME[:3] + [0.5, 0.2, 0.2]))
    )
    with Arm(config) as arm:
        arm.start()
        start_move(arm, controller)
        controller(do="place", tcp=(HOME + [0, 0.21, 0, 0, 0, 0]).tolist())
        assert check_stop(arm, controller) is SessionOutcome.OUT_OF_BOX


def test_a_collision_with_a_wall(controller: Faults) -> None:
    at = HOME[0] + 0.02
    with Arm(settings(controller.host, force_limit=20.0)) as arm:
        arm.start()
        controller(do="wall", x=at, stiffness=20_000)
        arm.move(AWAY)
        assert check_stop(arm, controller) is SessionOutcome.CONTACT
        assert controller.state()["penetration_max"] <= 0.003
        assert controller.state()["safety"] == "NORMAL"
        # The tool backs off along its path: out of the wall, at most by `backoff`.
        until(lambda: controller.state()["tcp"][0] < at - 0.006, "the tool backs off")
        until(arm.still)
        assert at - 0.0105 < controller.state()["tcp"][0]
        assert arm.fault.outcome is SessionOutcome.CONTACT


def test_a_contact_reported_by_the_session(arm: Arm, controller: Faults) -> None:
    start_move(arm, controller)
    until(lambda: controller.state()["tcp"][0] > HOME[0] + 0.012, "room for the retreat")
    arm.fail(SessionOutcome.CONTACT, "a whisker is bent too far")
    furthest = until(lambda: arm.still() and controller.state()["tcp"][0], "a standstill")
    until(lambda: controller.state()["tcp"][0] < furthest - 0.009, "the tool backs off")
    assert arm.fault.outcome is SessionOutcome.CONTACT
