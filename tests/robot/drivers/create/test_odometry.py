"""Odometry of a Create, which reports whole millimetres and degrees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.create import protocol
from robot.drivers.create.driver import CreateOdometry
from robot.emulators.create import CreateEmulatorConfig, EmulatedCreate
from tactile.base.se2 import compose

SPEED = st.integers(-protocol.TOP_SPEED, protocol.TOP_SPEED)
LEG = st.tuples(SPEED, SPEED, st.floats(0.005, 0.5), st.integers(1, 20))  # wheels, s, readings
LEGS = st.lists(LEG, min_size=1, max_size=12)


def readings(legs: list[tuple[int, int, float, int]]) -> tuple[EmulatedCreate, list[tuple[int, int, float]]]:
    """A robot after some legs, and its readings: mm, degrees, s."""
    robot = EmulatedCreate(CreateEmulatorConfig())
    robot.receive(protocol.START + protocol.SAFE)
    replies = []
    for right, left, seconds, count in legs:
        robot.receive(protocol.drive(right, left))
        for _ in range(count):
            robot.advance(seconds)
            (reply,) = robot.receive(protocol.QUERY)
            millimetres, degrees, *_ = protocol.REPLY.unpack(reply)
            replies.append((millimetres, degrees, robot.time))
    return robot, replies


@given(LEGS)
def test_sums_are_accurate_to_the_quantisation(legs: list[tuple[int, int, float, int]]) -> None:
    robot, replies = readings(legs)
    assert abs(sum(m for m, _, _ in replies) - 1000 * robot.base.travelled) < 1 + 1e-6
    assert abs(sum(d for _, d, _ in replies) - math.degrees(robot.base.turned)) < 1 + 1e-6


@given(LEGS)
def test_the_pose_is_accurate_to_the_quantisation(legs: list[tuple[int, int, float, int]]) -> None:
    robot, replies = readings(legs)
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
def test_odometry_read_in_parts_is_the_same(
    legs: list[tuple[int, int, float, int]], taken: list[bool]
) -> None:
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
