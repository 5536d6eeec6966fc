"""Bytes of the Open Interface: sent commands, accepted replies; odometry of whole millimetres, degrees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from robot.drivers.create import protocol
from robot.drivers.create.driver import CreateOdometry
from robot.drivers.create.driver_config import CommandRefused, CreateConfig
from robot.emulators.create import CreateEmulatorConfig, EmulatedCreate
from tactile.base.se2 import compose

SPEED = st.integers(-protocol.TOP_SPEED, protocol.TOP_SPEED)


def awake() -> EmulatedCreate:
    robot = EmulatedCreate(CreateEmulatorConfig())
    assert robot.receive(protocol.START + protocol.SAFE) == []
    return robot


@given(SPEED, SPEED, st.integers(1, 5))
def test_drive_commands_work_however_the_bytes_are_split(right: int, left: int, cut: int) -> None:
    robot = awake()
    command = protocol.drive(right, left)
    robot.receive(command[:cut])
    robot.receive(command[cut:])
    assert (robot.right, robot.left) == (right, left)
    assert robot.unknown == 0


@given(SPEED, SPEED, st.integers(0, 6))
def test_a_stop_works_after_an_incomplete_command(right: int, left: int, length: int) -> None:
    for command in (protocol.drive(right, left), protocol.QUERY):
        robot = awake()
        robot.receive(protocol.drive(200, 200) + command[:length])
        robot.receive(protocol.STOP_ANYHOW)
        assert (robot.right, robot.left) == (0, 0)


@pytest.mark.parametrize(("right", "left"), [(501, 0), (0, -501), (32767, 0)])
def test_commands_beyond_the_interface_are_refused(right: int, left: int) -> None:
    with pytest.raises(ValueError, match="limit of the Create is 500"):
        protocol.drive(right, left)


@given(SPEED, SPEED, st.floats(0, 3), st.sampled_from([0, 1, 2, 3, 4, 16, 31]))
def test_valid_replies_are_accepted(right: int, left: int, elapsed: float, bumps: int) -> None:
    robot = awake()
    robot.receive(protocol.drive(right, left))
    robot.touch(protocol.Bumps(bumps))
    robot.advance(elapsed)
    (reply,) = robot.receive(protocol.QUERY)
    found = protocol.SensorReply.parse(reply, elapsed)
    assert found.bumps == bumps
    assert found.mode == (protocol.Mode.PASSIVE if bumps > 3 else protocol.Mode.SAFE)
    assert abs(found.millimetres - 1000 * robot.base.travelled) < 1
    assert abs(found.degrees - math.degrees(robot.base.turned)) < 1


@given(st.binary(max_size=12), st.floats(0, 1))
@example(protocol.REPLY.pack(0, 0, 0, 2), 0.0)
@example(protocol.REPLY.pack(60, 0, 0, 2), 0.0)
@example(protocol.REPLY.pack(0, -60, 0, 2), 0.0)
@example(protocol.REPLY.pack(0, 0, 32, 2), 0.0)
@example(protocol.REPLY.pack(0, 0, 0, 0), 0.0)
@example(protocol.REPLY.pack(0, 0, 0, 4), 0.0)
def test_accepted_replies_are_possible(data: bytes, elapsed: float) -> None:
    found = protocol.SensorReply.parse(data, elapsed)
    if found is not None:
        assert protocol.REPLY.pack(*found) == data
        assert found.mode in (1, 2, 3)
        assert abs(found.millimetres) <= 500 * (elapsed + 0.1) + 5
        assert abs(found.degrees) <= 222 * (elapsed + 0.1) + 5
    else:
        assert data != protocol.REPLY.pack(0, 0, 0, 2)


@given(st.floats(0.0005, 0.5), st.floats(allow_infinity=True, allow_nan=True), st.floats())
@example(0.2, 0.2, 0.0)
@example(0.2004, 0.2004, 0.0)
@example(0.1996, 0.1996, 0.0)
@example(0.2, 0.2006, 0.0)
@example(0.5, 0.0, 3.875)
def test_wheel_speeds_are_within_the_limit(cap: float, forward: float, turn: float) -> None:
    config = CreateConfig(speed=cap)
    apart = turn * 0.258 / 2
    fits = max(abs(forward + apart), abs(forward - apart)) <= cap  # False for NaN
    try:
        right, left = config.wheel_speeds(forward, turn)
    except CommandRefused:
        assert not fits
        return
    assert max(abs(right), abs(left)) <= 1000 * cap + 1e-6
    assert abs(right - 1000 * (forward + apart)) < 1.001
    assert abs(left - 1000 * (forward - apart)) < 1.001


LEG = st.tuples(SPEED, SPEED, st.floats(0.005, 0.5), st.integers(1, 20))  # wheels, s, readings
LEGS = st.lists(LEG, min_size=1, max_size=12)


def readings(legs: list[tuple[int, int, float, int]]) -> tuple[EmulatedCreate, list[tuple[int, int, float]]]:
    """A robot after some legs, and its readings: mm, degrees, s."""
    robot, replies = awake(), []
    for right, left, seconds, count in legs:
        robot.receive(protocol.drive(right, left))
        for _ in range(count):
            robot.advance(seconds)
            (reply,) = robot.receive(protocol.QUERY)
            millimetres, degrees, *_ = protocol.REPLY.unpack(reply)
            replies.append((millimetres, degrees, robot.time))
    return robot, replies


@given(LEGS)
def test_sums_and_pose_are_accurate_to_the_quantisation(legs: list[tuple[int, int, float, int]]) -> None:
    robot, replies = readings(legs)
    assert abs(sum(m for m, _, _ in replies) - 1000 * robot.base.travelled) < 1 + 1e-6
    assert abs(sum(d for _, d, _ in replies) - math.degrees(robot.base.turned)) < 1 + 1e-6
    odometer = CreateOdometry(0.0)
    for reading in replies:
        odometer.add(*reading)
    dx, dy, dtheta, dt = odometer.take_odometry()
    driven = sum(abs(right + left) / 2000 * s * n for right, left, s, n in legs)
    turned = math.radians(sum(abs(d) for _, d, _ in replies))
    # Headings err by at most a degree; a millimetre is reported late, in another direction.
    bound = driven * math.radians(1) + 1e-3 * (1 + turned)
    assert math.hypot(dx - robot.base.x, dy - robot.base.y) <= bound + 1e-9
    assert abs(dtheta - robot.base.heading) < math.radians(1) + 1e-9
    assert dt == pytest.approx(robot.time)


@given(LEGS, st.lists(st.booleans(), min_size=240, max_size=240))
def test_odometry_read_in_parts_is_the_same(legs, taken):
    _, replies = readings(legs)
    whole, parts = CreateOdometry(0.0), CreateOdometry(0.0)
    pose, time = np.zeros(3), 0.0
    for reading, take in zip(replies, taken, strict=False):
        whole.add(*reading)
        parts.add(*reading)
        if take:
            *motion, dt = parts.take_odometry()
            pose, time = compose(pose, np.array(motion)), time + dt
    *motion, dt = parts.take_odometry()
    pose, time = compose(pose, np.array(motion)), time + dt
    total = whole.take_odometry()
    assert pose[:2] == pytest.approx(total[:2], abs=1e-9)
    assert math.cos(pose[2] - total.dtheta) == pytest.approx(1)
    assert time == pytest.approx(total.dt)


def test_motion_between_readings_is_an_arc() -> None:
    odometer = CreateOdometry(0.0)
    odometer.add(1571, 90, 1.0)  # a quarter of a circle of 1 m
    assert odometer.take_odometry() == pytest.approx((1.0, 1.0, math.pi / 2, 1.0), abs=2e-4)
    assert odometer.take_odometry() == (0, 0, 0, 0)
