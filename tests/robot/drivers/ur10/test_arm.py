"""The arm by the real library on an emulated controller: moves, faults, killed or hanging sessions."""

import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.dashboard import Dashboard
from robot.drivers.ur10.driver_config import BoxConfig
from robot.drivers.ur10.safety import SAFETY_STOPS, TargetRefused
from tests.helpers.live import PATIENCE, ROOT, moves, until
from tests.robot.drivers.ur10.conftest import AWAY, HOME, settings

TARGET = HOME + [0.01, 0.02, 0.0, 0.0, 0.0, 0.0]


def start_move(arm, controller):
    arm.move(AWAY)
    until(lambda: arm.fault or controller.state()["speed"][0] > 0.049, "the arm moves")
    assert arm.fault is None


def check_stop(arm, controller, within=PATIENCE):
    """Checks that a fault stops the arm in `within` s, before its target, for good; returns the outcome."""
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


def test_a_move_arrives(arm, controller):
    first = len(controller.state()["targets"])
    assert not arm.arrived()
    arm.move(HOME)
    until(arm.arrived, "arrival without motion")
    move = arm.move(TARGET)
    assert not arm.arrived()
    began = time.monotonic()
    until(arm.arrived, "arrival")
    assert time.monotonic() - began > 0.5 * move.seconds
    np.testing.assert_allclose(controller.state()["tcp"], TARGET, atol=1e-9)
    *_, reached = moves(controller, first)
    np.testing.assert_array_equal(reached["goal"], TARGET)
    assert (reached["speed"], reached["acceleration"]) == (arm.config.speed, arm.config.acceleration)
    assert max(math.hypot(*state["speed"][:3]) for state in arm.states()) <= arm.config.speed + 1e-9
    assert arm.fault is None


def test_states_are_in_order(arm):
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


def test_moves_after_a_halt_and_instead_of_an_older_move(arm, controller):
    start_move(arm, controller)
    arm.halt()
    until(lambda: not controller.state()["moving"], "a standstill")
    assert controller.state()["tcp"][0] < AWAY[0] - 1e-3
    assert not arm.arrived()
    start_move(arm, controller)
    arm.move(TARGET)
    until(arm.arrived, "arrival")
    np.testing.assert_allclose(controller.state()["tcp"], TARGET, atol=1e-9)
    assert arm.fault is None
    assert controller.state()["watchdog_stops"] == 0


STALE, MALFORMED, GONE = SessionOutcome.ARM_STALE, SessionOutcome.ARM_MALFORMED, SessionOutcome.ARM_GONE
FAULTS = {
    "protective": SessionOutcome.PROTECTIVE_STOP, "safeguard": SessionOutcome.SAFEGUARD_STOP,
    "place": SessionOutcome.OUT_OF_BOX, "stall": STALE, "malformed": MALFORMED, "truncated": MALFORMED,
    "huge": STALE, "nan": MALFORMED, "freeze": STALE, "the program is ended": GONE,
    "the process crashes": GONE, "the process hangs": STALE,
}  # fmt: skip
MORE = {"stall": {"seconds": PATIENCE}, "place": {"tcp": (HOME + [0, 0.21, 0, 0, 0, 0]).tolist()}}
BOX = BoxConfig(low=tuple(HOME[:3] - 0.2), high=tuple(HOME[:3] + [0.5, 0.2, 0.2]))


@pytest.mark.parametrize("fault", [*FAULTS, pytest.param("emergency", marks=pytest.mark.soak)])
def test_a_fault_stops_the_arm(controller, fault):
    outcome = FAULTS.get(fault, SessionOutcome.EMERGENCY_STOP)
    with Arm(settings(controller.host, stale=1.0 if outcome is STALE else 30.0, box=BOX)) as arm:
        arm.start()
        start_move(arm, controller)
        if fault == "the program is ended":
            with Dashboard(controller.host) as dashboard:
                dashboard.stop()
        elif fault.startswith("the process"):
            os.kill(arm.process.pid, signal.SIGSTOP if "hangs" in fault else signal.SIGSEGV)
        else:
            controller(do=fault, **MORE.get(fault, {}))
        assert check_stop(arm, controller) is outcome
        assert len(arm.history) > 10
        assert fault == "nan" or np.isfinite(arm.history["tcp"]).all()
        if outcome in SAFETY_STOPS:
            # States continue, so the pose stays known; once the stop is released the program does not resume.
            until(lambda: arm.age() < 0.05, "a fresh state")
            until(lambda: controller.state()["runtime"] == "STOPPED", "the program is ended")
            place = controller.state()["tcp"]
            controller(do="clear")
            time.sleep(0.15)
            assert controller.state()["tcp"] == place
            np.testing.assert_allclose(arm.latest()["tcp"], place, atol=1e-9)


@pytest.mark.soak
def test_a_stall_is_detected_in_time(controller):
    with Arm(settings(controller.host, stale=0.5)) as arm:
        arm.start()
        start_move(arm, controller)
        controller(do="stall", seconds=3.0)
        began = time.monotonic()
        assert check_stop(arm, controller, within=0.5) is STALE
        assert arm.fault.time - began < arm.config.stale + 0.3


def test_the_controller_dies(arm, controller):
    start_move(arm, controller)
    controller.die()
    assert until(lambda: arm.fault, "a fault").outcome is GONE


def test_a_stop_without_effect_is_repeated_by_the_dashboard(arm, controller):
    start_move(arm, controller)
    ends = controller.state()["program_stops"]
    os.kill(arm.process.pid, signal.SIGSTOP)
    arm.halt()
    until(lambda: not controller.state()["moving"], "a standstill")
    assert controller.state()["program_stops"] > ends
    assert controller.state()["tcp"][0] < AWAY[0] - 1e-3
    os.kill(arm.process.pid, signal.SIGKILL)


def test_a_target_without_joint_solution(arm, controller):
    first = len(controller.state()["targets"])
    controller(do="ik_fails")
    arm.move(AWAY)
    assert check_stop(arm, controller) is SessionOutcome.UNREACHABLE
    assert moves(controller, first) == []


def test_a_move_that_does_not_arrive(controller):
    with Arm(settings(controller.host, patience=0.3)) as arm:
        arm.start()
        arm.move(HOME + [0.01, 0, 0, 0, 0, 0])
        controller(do="slider", fraction=0.0)
        assert check_stop(arm, controller) is SessionOutcome.NOT_ARRIVED


def test_a_collision_with_a_wall(controller):
    at = HOME[0] + 0.02
    with Arm(settings(controller.host, force_limit=20.0)) as arm:
        arm.start()
        controller(do="wall", x=at, stiffness=20_000)
        arm.move(AWAY)
        assert check_stop(arm, controller) is SessionOutcome.CONTACT
        assert controller.state()["penetration_max"] <= 0.003
        assert controller.state()["safety"] == "NORMAL"
        until(lambda: controller.state()["tcp"][0] < at - 0.006, "the tool backs off")
        until(arm.still)
        assert at - 0.0105 < controller.state()["tcp"][0]


def test_a_contact_reported_by_the_session(arm, controller):
    start_move(arm, controller)
    until(lambda: controller.state()["tcp"][0] > HOME[0] + 0.012, "room for the retreat")
    arm.fail(SessionOutcome.CONTACT, "a whisker is bent too far")
    furthest = until(lambda: arm.still() and controller.state()["tcp"][0], "a standstill")
    until(lambda: controller.state()["tcp"][0] < furthest - 0.009, "the tool backs off")
    assert arm.fault.outcome is SessionOutcome.CONTACT


def test_the_rtde_process_checks_every_command(arm, controller):
    first = len(controller.state()["targets"])
    here, stops = controller.state()["tcp"], int(arm.shared.control["stops"])
    for number, target in enumerate(([math.nan] * 6, [9.0, *here[1:]], here[:5], [*here[:3], 0.0, 0.0, 0.0])):
        arm.process.send(do="move", number=number, target=target, speed=0.01, stops=stops)
    arm.process.send(do="move", number=9, target=[here[0] + 0.05, *here[1:]], speed=0.3, stops=stops)
    assert "refused" in until(lambda: arm.fault, "a fault").detail
    assert moves(controller, first) == []
    assert controller.state()["tcp"] == here
    os.kill(arm.process.pid, 0)


SESSION = """
import sys, time
from robot.drivers.ur10.arm import Arm
from tests.robot.drivers.ur10.conftest import settings
arm = Arm(settings(sys.argv[1], heartbeat=1.0, watchdog_hz=2.0))
arm.start()
arm.move([float(number) for number in sys.argv[2:]])
print(arm.process.pid, flush=True)
time.sleep(600)
"""


def runs(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("what", ["killed", "hangs", "killed with the arm's process"])
def test_the_arm_stops_when_the_session_ends_or_hangs(controller, what):
    words = [sys.executable, "-c", SESSION, controller.host, *map(repr, AWAY.tolist())]
    session = subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    try:
        pid = int(session.stdout.readline())
        maps = Path(f"/proc/{session.pid}/maps").read_text().splitlines()
        shared = [line.split(maxsplit=5)[5] for line in maps if "/dev/shm/" in line]
        until(lambda: controller.state()["speed"][0] > 0.049, "the arm moves")
        bites = controller.state()["watchdog_stops"]
        both = what == "killed with the arm's process"
        if both:
            os.kill(pid, signal.SIGSTOP)  # so that it does not detect the end first
        session.send_signal(signal.SIGSTOP if what == "hangs" else signal.SIGKILL)
        if both:
            os.kill(pid, signal.SIGKILL)
        until(lambda: not controller.state()["moving"], "a standstill")
        place = controller.state()["tcp"]
        assert place[0] < AWAY[0] - 1e-3, "the arm reached its target"
        until(lambda: not runs(pid), "the arm's process ends")
        until(lambda: controller.state()["runtime"] == "STOPPED", "the controller's program ends")
        assert controller.state()["tcp"] == place
        assert not both or controller.state()["watchdog_stops"] == bites + 1
        if what != "hangs":
            session.wait(30)
            assert not [name for name in shared if Path(name).exists()], "shared memory remains"
    finally:
        session.kill()
        session.wait(30)
        session.stdout.close()
