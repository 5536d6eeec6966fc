"""The control loop under faults of line and robot, in simulated time."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from robot.drivers.create import protocol
from robot.drivers.create.driver import PAUSE, ControlLoop
from robot.drivers.create.driver_config import CommandRefused, CreateConfig, StopReason
from robot.drivers.create.serial_link import SerialLink
from robot.emulators.create import CreateEmulatorConfig, EmulatedCreate

PERIOD = 0.05
NUMBER = st.one_of(st.floats(-0.3, 0.3), st.floats())


class Line:
    """A serial port in memory: commands reach the robot at once, `mangle` changes its replies.

    Attributes:
        now: its clock, s; a read that times out advances it.
    """

    def __init__(self) -> None:
        self.robot = EmulatedCreate(CreateEmulatorConfig())
        self.now, self.timeout = 100.0, 0.0
        self.mangle: Callable[[bytes], bytes] = lambda reply: reply
        self.gone = False
        self._waiting = b""

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.robot.advance(seconds)

    def clock(self) -> float:
        return self.now

    @property
    def in_waiting(self) -> int:
        self._attached()
        return len(self._waiting)

    def read(self, size: int = 1) -> bytes:
        self._attached()
        data, self._waiting = self._waiting[:size], self._waiting[size:]
        if len(data) < size:
            self.wait(self.timeout or 0.0)
        return data

    def write(self, data: bytes) -> int:
        self._attached()
        for reply in self.robot.receive(data):
            self._waiting += self.mangle(reply)
        return len(data)

    def arrive(self, data: bytes) -> None:
        """Makes bytes arrive without a query."""
        self._waiting += data

    def close(self) -> None: ...

    def _attached(self) -> None:
        if self.gone:
            raise OSError(5, "Input/output error")

    def control_loop(self, **settings: Any) -> ControlLoop:
        """A control loop of this robot, which is awake and in safe mode."""
        link = SerialLink(self)
        for command in (protocol.START, protocol.SAFE):
            link.send(command)
            self.wait(PAUSE)
        link.ask(float("inf"))
        return ControlLoop(CreateConfig(**settings), link, self.clock)


def rolls(robot: EmulatedCreate) -> bool:
    return bool(robot.right or robot.left)


def check_stop(loop: ControlLoop, reason: StopReason) -> None:
    assert loop.active_stop.reason is reason


def drive(line: Line, loop: ControlLoop, seconds: float, forward: float, turn: float = 0.0) -> None:
    """Polls and steers for some seconds; refused commands are repeated."""
    for _ in range(round(seconds / PERIOD)):
        try:
            loop.steer(forward, turn)
        except CommandRefused:
            assert loop.active_stop
        loop.poll()
        line.wait(PERIOD)


@pytest.fixture
def line() -> Line:
    return Line()


@pytest.fixture
def loop(line: Line) -> ControlLoop:
    return line.control_loop()


@given(st.floats(0.01, 0.5), st.lists(st.tuples(NUMBER, NUMBER), max_size=10))
def test_speeds_above_the_limit_are_not_sent(cap: float, wanted: list[tuple[float, float]]) -> None:
    line = Line()
    loop = line.control_loop(speed=cap)
    for forward, turn in wanted:
        with contextlib.suppress(CommandRefused):
            loop.steer(forward, turn)
        loop.poll()
        line.wait(PERIOD)
    assert len(line.robot.drives) == len(wanted)
    assert all(max(abs(right), abs(left)) <= 1000 * cap + 1e-6 for _, right, left in line.robot.drives)


def test_a_command_that_is_not_renewed_ends(line: Line) -> None:
    loop = line.control_loop(patience=0.5)
    loop.steer(0.1, 0.0)
    rolled = []
    for _ in range(20):
        loop.poll()
        rolled.append(rolls(line.robot))
        line.wait(PERIOD)
    assert rolled == [True] * rolled.count(True) + [False] * rolled.count(False)
    assert 0.4 <= PERIOD * rolled.count(True) <= 0.6
    assert loop.active_stop is None
    drive(line, loop, 0.2, 0.1)
    assert rolls(line.robot)


def test_a_bump_stops_forward_motion_only(line: Line, loop: ControlLoop) -> None:
    drive(line, loop, 0.5, 0.1)
    line.robot.touch(protocol.Bumps.LEFT)
    loop.poll()
    assert not rolls(line.robot)
    check_stop(loop, StopReason.BUMPED)
    assert "left" in str(loop.active_stop)
    with pytest.raises(CommandRefused, match="bumped"):
        loop.steer(-0.1, 0.0)
    loop.release()
    drive(line, loop, 0.5, -0.1)
    assert line.robot.right == -100
    before = len(line.robot.drives)
    drive(line, loop, 0.5, 0.1)  # still pressed: no motion
    assert all(right + left <= 0 for _, right, left in line.robot.drives[before:])
    assert loop.active_stop is not None


@pytest.mark.parametrize("forward", [0.1, -0.1, 0.0])
@pytest.mark.parametrize("dropped", [protocol.Bumps.DROPPED_LEFT, protocol.Bumps.DROPPED_CASTER])
def test_a_dropped_wheel_stops_the_robot_until_it_stands(dropped, forward, line, loop):
    drive(line, loop, 0.2, forward, 0.2)
    line.robot.touch(dropped)
    drive(line, loop, 0.2, forward, 0.2)
    check_stop(loop, StopReason.WHEEL_DROP)
    loop.release()
    drive(line, loop, 0.2, forward, 0.2)
    assert loop.active_stop is not None  # the wheel still hangs
    line.robot.touch(protocol.Bumps(0))
    loop.release()
    drive(line, loop, 0.2, forward, 0.2)
    assert rolls(line.robot)


def test_safe_mode_is_entered_again_by_release_only(line: Line, loop: ControlLoop) -> None:
    drive(line, loop, 0.2, 0.1)
    line.robot.touch(protocol.Bumps(0), cliff=True)
    drive(line, loop, 1.0, 0.1)
    check_stop(loop, StopReason.LEFT_SAFE_MODE)
    assert line.robot.mode == protocol.Mode.PASSIVE
    loop.release()
    drive(line, loop, 0.2, 0.1)
    assert line.robot.mode == protocol.Mode.SAFE
    assert rolls(line.robot)


@pytest.mark.parametrize(("reply", "halt"), [(b"", StopReason.SILENT), (b"\xff" * 6, StopReason.GARBLED)])
def test_a_lost_link_stops_the_wheels(reply: bytes, halt: StopReason, line: Line) -> None:
    loop = line.control_loop(silence=0.3)
    drive(line, loop, 0.5, 0.1)
    line.mangle, since = lambda _: reply, line.now
    while rolls(line.robot):
        assert line.now - since <= 0.3 + 0.1 + 2 * PERIOD
        drive(line, loop, PERIOD, 0.1)
    check_stop(loop, halt)
    line.mangle = lambda reply: reply
    drive(line, loop, 0.5, 0.1)
    assert not rolls(line.robot)  # no automatic restart
    loop.release()
    drive(line, loop, 0.5, 0.1)
    assert rolls(line.robot)


def test_an_unplugged_port_is_final(line: Line, loop: ControlLoop) -> None:
    drive(line, loop, 0.2, 0.1)
    line.gone = True
    drive(line, loop, 0.2, 0.1)
    check_stop(loop, StopReason.UNPLUGGED)
    with pytest.raises(CommandRefused, match="unplugged"):
        loop.release()


@given(
    st.lists(st.sampled_from(["in time", "late", "behind"]), min_size=1, max_size=30), st.floats(-0.2, 0.2)
)
def test_a_late_reply_loses_nothing(fates: list[str], forward: float) -> None:
    """`late`: the reply arrives before the next query; `behind`: after it, just before the next reply."""
    line = Line()
    loop = line.control_loop(silence=5.0)
    late, behind = [], []

    def mangle(reply: bytes) -> bytes:
        fate = fates.pop(0) if fates else "in time"
        if fate == "late":
            late.append(reply)
        if fate == "behind":
            behind.append(reply)
        held = b"" if fate != "in time" else b"".join(behind)
        behind[:] = behind if fate != "in time" else []
        return held + (reply if fate == "in time" else b"")

    line.mangle = mangle
    while fates:
        drive(line, loop, PERIOD, forward)
        while late:
            line.arrive(late.pop(0))
    for _ in range(3):
        loop.poll()
    total = loop.take_odometry()
    assert abs(1000 * (total.dx - line.robot.base.travelled)) < 1 + 1e-6
    assert loop.link.counts.stray == 0
    assert loop.link.counts.lost == loop.link.counts.late
    assert not loop.gap()


added = st.tuples(st.sampled_from(["before", "instead"]), st.binary(max_size=40))
garbage = st.none() | added | st.tuples(st.just("cut"), st.binary(max_size=5))


@given(st.lists(garbage, min_size=1, max_size=25), st.floats(-0.2, 0.2))
def test_garbage_costs_only_the_replies_that_it_damages(noise, forward):
    line = Line()
    loop = line.control_loop(silence=5.0)
    pending = [*noise, *[None] * 3]

    def mangle(reply: bytes) -> bytes:
        how, data = (pending and pending[0]) or ("before", b"")
        return {"before": data + reply, "instead": data, "cut": reply[: len(data)]}[how]

    line.mangle = mangle
    spoilt, steps = 0.0, []
    while pending:
        before, lost = line.robot.base.travelled, loop.link.counts.lost
        drive(line, loop, PERIOD, forward)
        steps.append(abs(line.robot.base.travelled - before))
        if loop.link.counts.lost > lost:  # it covered the time since the previous reading
            spoilt += sum(steps[-2:])
        pending.pop(0)
    loop.poll()
    missing = line.robot.base.travelled - loop.take_odometry().dx
    assert abs(missing) <= spoilt + 1e-3 + 1e-9
    assert loop.gap() == (loop.link.counts.lost > 0)
    assert math.copysign(1, missing) == math.copysign(1, forward) or abs(missing) <= 1e-3 + 1e-9


@given(st.integers(1, 40), st.sampled_from([b"\xff", b"\0"]), st.floats(-0.2, 0.2))
@example(4, b"\xff", 0.125)  # noise and a motion of 3 mm look like a reply of full mode
def test_garbage_before_a_reply_costs_nothing(count: int, noise: bytes, forward: float) -> None:
    line = Line()
    loop = line.control_loop()
    line.mangle = lambda reply: noise * count + reply
    drive(line, loop, 1.0, forward)
    drive(line, loop, 0.1, 0.0)
    assert loop.active_stop is None
    assert not loop.gap()
    assert loop.link.counts.stray == count * loop.link.counts.good - count  # the first reply is undisturbed
    assert abs(1000 * (loop.take_odometry().dx - line.robot.base.travelled)) < 1 + 1e-6


def test_a_command_given_during_a_read_is_checked(line: Line, loop: ControlLoop) -> None:
    line.robot.touch(protocol.Bumps.RIGHT)

    def mangle(reply: bytes) -> bytes:
        loop.steer(0.1, 0.0)
        return reply

    line.mangle = mangle
    loop.poll()
    assert loop.active_stop
    assert not rolls(line.robot)


def test_commands_from_before_a_stop_are_dropped(line: Line, loop: ControlLoop) -> None:
    drive(line, loop, 0.5, 0.1)
    line.robot.touch(protocol.Bumps.RIGHT)
    loop.poll()
    line.robot.touch(protocol.Bumps(0))
    loop.release()
    for _ in range(3):
        line.wait(PERIOD)
        loop.poll()
        assert not rolls(line.robot)
    assert loop.active_stop is None


def test_a_reply_followed_by_noise_is_rejected(line: Line, loop: ControlLoop) -> None:
    drive(line, loop, 0.2, 0.1)
    assert not loop.gap()
    line.arrive(b"\0\0\0")
    drive(line, loop, 0.2, 0.1)
    assert loop.gap()
    assert not loop.gap()
