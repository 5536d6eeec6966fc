"""Checks of commands, without a controller: in the RTDE process and in the session."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.driver_config import SPEED_CAP, ArmConfig
from robot.drivers.ur10.rtde_process import ArmCommand, CommandThread
from robot.drivers.ur10.safety import MIN_SPEED, TargetRefused
from robot.drivers.ur10.shared_state import SharedState
from tests.robot.drivers.ur10.conftest import HOME
from tests.robot.drivers.ur10.test_safety import a_state

CONFIG = ArmConfig()
number = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-1.3, 1.3))
poses = st.one_of(
    st.lists(number, min_size=0, max_size=8),
    st.tuples(st.floats(-0.3, 1.6), st.floats(-0.3, 1.2), st.floats(-4, 4), st.floats(-0.2, 0.5)).map(
        lambda v: CONFIG.placing.tcp_from_pose(np.array(v[:3]), v[3]).tolist()
    ),
)
speeds = st.one_of(number, st.floats(0.001, 0.06), st.sampled_from([0.25, 0.2501, 0.05, 0.1, 0.0, -0.05]))


class Control:
    """A stub of the library's control interface."""

    def __init__(self) -> None:
        self.moves: list[tuple[Any, ...]] = []
        self.stops = self.kicks = 0
        self.reachable = True

    def stopL(self, deceleration: float, asynchronous: bool) -> None:
        self.stops += 1

    def kickWatchdog(self) -> bool:
        self.kicks += 1
        return True

    def isPoseWithinSafetyLimits(self, pose: list[float]) -> bool:
        return self.reachable

    def moveL(self, *call: Any) -> bool:
        self.moves.append(call)
        return True


@pytest.fixture(scope="module")
def shared() -> Iterator[SharedState]:
    shared = SharedState()
    shared.publish(a_state())
    yield shared
    shared.close()


def command_thread(shared: SharedState) -> tuple[CommandThread, Control, list[dict[str, Any]]]:
    """A command thread without a controller, and its reports to the session."""
    control, reports = Control(), []
    return CommandThread(CONFIG, shared, control, lambda **fields: reports.append(fields)), control, reports


@given(poses, speeds, st.sampled_from(["move", "retreat"]))
def test_no_invalid_move_is_sent_to_the_controller(
    shared: SharedState, pose: list[float], speed: float, do: str
) -> None:
    thread, control, reports = command_thread(shared)
    thread.execute(ArmCommand(do, 1, tuple(pose), speed, int(shared.control["stops"])))
    if not control.moves:
        (fault,) = reports
        assert fault["say"] == "fault"
        assert thread.held is not None
        thread.execute(ArmCommand("move", 2, tuple(HOME), 0.01, int(shared.control["stops"])))
        assert not control.moves
        return
    ((target, speed, acceleration, asynchronous),) = control.moves
    assert target == pose
    assert len(target) == 6
    assert np.isfinite(target).all()
    assert CONFIG.box.contains(np.array(target))
    assert 0 < speed <= SPEED_CAP
    way = math.dist(target[:3], HOME[:3])
    assert min(speed, math.sqrt(CONFIG.acceleration * way)) <= CONFIG.speed
    assert way <= CONFIG.backoff + 0.002 or do == "move"
    assert acceleration == CONFIG.acceleration
    assert asynchronous is True


def test_a_stop_revokes_the_orders_before_it(shared: SharedState) -> None:
    thread, control, _ = command_thread(shared)
    order = ArmCommand("move", 1, tuple(HOME), 0.01, int(shared.control["stops"]))
    shared.control["stops"] += 1
    thread.execute(order)
    assert control.moves == []
    thread.act()  # sends the stop
    thread.execute(order)
    assert control.moves == []
    thread.execute(order._replace(stops=int(shared.control["stops"])))
    assert len(control.moves) == 1


def test_the_watchdog_is_reset_only_while_the_heartbeat_is_recent(shared: SharedState) -> None:
    thread, control, _ = command_thread(shared)
    shared.control["heartbeat"] = time.monotonic() + 60  # longer than any delay of this test
    thread.act()
    assert (control.kicks, control.stops) == (1, 0)
    shared.control["heartbeat"] = time.monotonic() - CONFIG.heartbeat - 0.001
    thread.act()
    assert control.kicks == 1


def test_a_stop_is_sent_before_queued_moves(shared: SharedState) -> None:
    thread, control, _ = command_thread(shared)
    stops = int(shared.control["stops"])
    thread.put(ArmCommand("move", 1, tuple(HOME), 0.01, stops))
    shared.control["stops"] += 1
    thread.put(ArmCommand("move", 2, tuple(HOME), 0.02, stops + 1))
    thread.act()
    assert control.stops == 1
    assert [call[1] for call in control.moves] == [0.02]
    thread.leaving = True
    thread.put(ArmCommand("move", 3, tuple(HOME), 0.01, stops + 1))
    thread.act()
    assert len(control.moves) == 1


def test_a_target_without_joint_solution_is_not_sent(shared: SharedState) -> None:
    thread, control, reports = command_thread(shared)
    control.reachable = False
    thread.execute(ArmCommand("move", 1, tuple(HOME), 0.01, int(shared.control["stops"])))
    assert control.moves == []
    assert [fault["outcome"] for fault in reports] == [SessionOutcome.UNREACHABLE.name]


class Link:
    """A stub of the RTDE process."""

    def __init__(self) -> None:
        self.orders: list[dict[str, Any]] = []

    def send(self, **fields: Any) -> None:
        self.orders.append(fields)

    def end(self, patience: float) -> bool:
        return True

    def kill(self) -> None:
        pass


@pytest.fixture(scope="module")
def stub_arm() -> Iterator[tuple[Arm, Link]]:
    """An armed arm without an RTDE process."""
    with Arm(CONFIG) as arm:
        link = Link()
        arm.shared.publish(a_state())
        arm.process, arm.armed = link, True  # type: ignore[assignment]
        yield arm, link


@given(poses, st.one_of(st.none(), speeds))
def test_no_invalid_move_is_sent_to_the_rtde_process(
    stub_arm: tuple[Arm, Link], pose: list[float], speed: float | None
) -> None:
    arm, link = stub_arm
    link.orders.clear()
    try:
        move = arm.move(pose, speed)
    except TargetRefused:
        assert link.orders == []
        return
    (order,) = link.orders
    assert order["target"] == pose
    assert np.isfinite(pose).all()
    assert CONFIG.box.contains(np.array(pose))
    assert speed is None or MIN_SPEED <= speed <= CONFIG.speed
    assert 0 < order["speed"] == move.speed <= SPEED_CAP
