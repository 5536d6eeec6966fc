"""Bytes and odometry of the Open Interface; the control loop under faults, in simulated time."""

import contextlib
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from robot.drivers.create import protocol
from robot.drivers.create.driver_config import CommandRefused, CreateConfig, StopReason
from robot.drivers.create.wheel_counters import CreateOdometry
from robot.emulators.create import CreateEmulatorConfig, EmulatedCreate
from robot.emulators.create.emulator_config import CreateWorldConfig, FirmwareConfig
from robot.world.arena import Arena
from tactile.base.se2 import compose
from tests.helpers.create_line import Line, SimulatedDriver

PERIOD = 0.05
CREATE_1 = protocol.MODELS["create1"]
NUMBER = st.one_of(st.floats(-0.3, 0.3), st.floats())


def rolls(robot):
    return bool(robot.right or robot.left)


def drive(line, loop, seconds, forward, turn=0.0):
    for _ in range(round(seconds / PERIOD)):
        try:
            loop.steer(forward, turn)
        except CommandRefused:
            assert loop.active_stop
        loop.poll()
        line.wait(PERIOD)


@pytest.fixture
def line():
    return Line()


@pytest.fixture
def loop(line):
    return line.control_loop()


@given(st.floats(0.01, 0.5), st.lists(st.tuples(NUMBER, NUMBER), max_size=10))
def test_speeds_above_the_limit_are_not_sent(cap, wanted):
    line = Line()
    loop = line.control_loop(speed=cap)
    for forward, turn in wanted:
        with contextlib.suppress(CommandRefused):
            loop.steer(forward, turn)
        loop.poll()
        line.wait(PERIOD)
    assert len(line.robot.drives) == len(wanted)
    assert all(max(abs(right), abs(left)) <= 1000 * cap + 1e-6 for _, right, left in line.robot.drives)


def test_a_command_that_is_not_renewed_ends(line):
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


def test_a_bump_stops_forward_motion_only(line, loop):
    drive(line, loop, 0.5, 0.1)
    line.robot.touch(protocol.Bumps.LEFT)
    loop.poll()
    assert not rolls(line.robot)
    assert loop.active_stop.reason is StopReason.BUMPED
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
    assert loop.active_stop.reason is StopReason.WHEEL_DROP
    loop.release()
    drive(line, loop, 0.2, forward, 0.2)
    assert loop.active_stop is not None  # the wheel still hangs
    line.robot.touch(protocol.Bumps(0))
    loop.release()
    drive(line, loop, 0.2, forward, 0.2)
    assert rolls(line.robot)


def test_safe_mode_is_entered_again_by_release_only(line, loop):
    drive(line, loop, 0.2, 0.1)
    line.robot.touch(protocol.Bumps(0), cliff=True)
    drive(line, loop, 1.0, 0.1)
    assert loop.active_stop.reason is StopReason.LEFT_SAFE_MODE
    assert line.robot.mode == protocol.Mode.PASSIVE
    loop.release()
    drive(line, loop, 0.2, 0.1)
    assert line.robot.mode == protocol.Mode.SAFE
    assert rolls(line.robot)


@pytest.mark.parametrize(("reply", "halt"), [(b"", StopReason.SILENT), (b"\xff" * 6, StopReason.GARBLED)])
def test_a_lost_link_stops_the_wheels(reply, halt, line):
    loop = line.control_loop(silence=0.3)
    drive(line, loop, 0.5, 0.1)
    line.mangle, since = lambda _: reply, line.now
    while rolls(line.robot):
        assert line.now - since <= 0.3 + 0.1 + 2 * PERIOD
        drive(line, loop, PERIOD, 0.1)
    assert loop.active_stop.reason is halt
    line.mangle = lambda reply: reply
    drive(line, loop, 0.5, 0.1)
    assert not rolls(line.robot)  # no automatic restart
    loop.release()
    drive(line, loop, 0.5, 0.1)
    assert rolls(line.robot)


def test_an_unplugged_port_is_final(line, loop):
    drive(line, loop, 0.2, 0.1)
    line.gone = True
    drive(line, loop, 0.2, 0.1)
    assert loop.active_stop.reason is StopReason.UNPLUGGED
    with pytest.raises(CommandRefused, match="unplugged"):
        loop.release()


FATES = st.lists(st.sampled_from(["in time", "late", "behind"]), min_size=1, max_size=30)


@given(FATES, st.floats(-0.2, 0.2))
def test_a_late_reply_loses_nothing(fates, forward):
    """`late`: the reply arrives before the next query; `behind`: after it, just before the next reply."""
    line = Line()
    loop = line.control_loop(silence=5.0)
    held = {"late": [], "behind": []}

    def mangle(reply):
        fate = fates.pop(0) if fates else "in time"
        if fate != "in time":
            held[fate].append(reply)
            return b""
        before, held["behind"] = held["behind"], []
        return b"".join([*before, reply])

    line.mangle = mangle
    while fates:
        drive(line, loop, PERIOD, forward)
        line.waiting += b"".join(held.pop("late"))
        held["late"] = []
    for _ in range(3):
        loop.poll()
    total = loop.take_odometry()
    assert abs(1000 * (total.dx - line.robot.base.travelled)) < 1 + 1e-6
    assert (loop.link.counts.stray, loop.link.counts.lost) == (0, loop.link.counts.late)
    assert not loop.gap()


added = st.tuples(st.sampled_from(["before", "instead"]), st.binary(max_size=40))
garbage = st.none() | added | st.tuples(st.just("cut"), st.binary(max_size=5))


@given(st.lists(garbage, min_size=1, max_size=25), st.floats(-0.2, 0.2))
def test_garbage_costs_only_the_replies_that_it_damages(noise, forward):
    line = Line()
    loop = line.control_loop(silence=5.0)
    pending = [*noise, *[None] * 3]

    def mangle(reply):
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
def test_garbage_before_a_reply_costs_nothing(count, noise, forward):
    line = Line()
    loop = line.control_loop()
    line.mangle = lambda reply: noise * count + reply
    drive(line, loop, 1.0, forward)
    drive(line, loop, 0.1, 0.0)
    assert loop.active_stop is None
    assert not loop.gap()
    assert loop.link.counts.stray == count * loop.link.counts.good - count  # the first reply is undisturbed
    assert abs(1000 * (loop.take_odometry().dx - line.robot.base.travelled)) < 1 + 1e-6


def test_a_command_given_during_a_read_is_checked(line, loop):
    line.robot.touch(protocol.Bumps.RIGHT)
    line.mangle = lambda reply: loop.steer(0.1, 0.0) or reply
    loop.poll()
    assert loop.active_stop
    assert not rolls(line.robot)


def test_commands_from_before_a_stop_are_dropped(line, loop):
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


def test_a_reply_followed_by_noise_is_rejected(line, loop):
    drive(line, loop, 0.2, 0.1)
    assert not loop.gap()
    line.waiting += b"\0\0\0"
    drive(line, loop, 0.2, 0.1)
    assert loop.gap()
    assert not loop.gap()


SPEED = st.integers(-protocol.TOP_SPEED, protocol.TOP_SPEED)


def awake():
    robot = EmulatedCreate(CreateEmulatorConfig())
    assert robot.receive(protocol.START + protocol.SAFE) == []
    return robot


@given(SPEED, SPEED, st.integers(0, 6))
def test_a_stop_works_after_an_incomplete_command(right, left, length):
    for command in (protocol.drive(right, left), protocol.QUERY):
        robot = awake()
        robot.receive(protocol.drive(200, 200) + command[:length])
        robot.receive(protocol.STOP_ANYHOW)
        assert (robot.right, robot.left) == (0, 0)


@pytest.mark.parametrize(("right", "left"), [(501, 0), (0, -501), (32767, 0)])
def test_commands_beyond_the_interface_are_refused(right, left):
    with pytest.raises(ValueError, match="limit of the Create is 500"):
        protocol.drive(right, left)


@given(SPEED, SPEED, st.floats(0, 3), st.sampled_from([0, 1, 2, 3, 4, 16, 31]))
def test_valid_replies_are_accepted(right, left, elapsed, bumps):
    robot = awake()
    robot.receive(protocol.drive(right, left))
    robot.touch(protocol.Bumps(bumps))
    robot.advance(elapsed)
    (reply,) = robot.receive(protocol.QUERY)
    found = CREATE_1.parse(reply, elapsed)
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
def test_accepted_replies_are_possible(data, elapsed):
    found = CREATE_1.parse(data, elapsed)
    if found is not None:
        assert protocol.REPLY.pack(*found[:4]) == data
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
def test_wheel_speeds_are_within_the_limit(cap, forward, turn):
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


def readings(legs):
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
def test_sums_and_pose_are_accurate_to_the_quantisation(legs):
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
    for k, reading in enumerate(replies):
        whole.add(*reading)
        parts.add(*reading)
        if taken[k] or reading is replies[-1]:
            *motion, dt = parts.take_odometry()
            pose, time = compose(pose, np.array(motion)), time + dt
    total = whole.take_odometry()
    assert pose[:2] == pytest.approx(total[:2], abs=1e-9)
    assert math.cos(pose[2] - total.dtheta) == pytest.approx(1)
    assert time == pytest.approx(total.dt)


def emulated(**firmware):
    """A robot whose firmware has these settings, on a line of its own."""
    firmware = FirmwareConfig(**firmware)
    base = protocol.MODELS[firmware.model].wheel_base
    return Line(CreateEmulatorConfig(firmware=firmware, wheel_base=base))


def turned_and_driven(line, **settings):
    """Errors of the odometry, degrees and m, of a full turn at 5 degrees/s and of 2 m at 0.1 m/s."""
    driver = SimulatedDriver(line, CreateConfig(**settings))
    errors = []
    for forward, turn, seconds in ((0.0, math.radians(5), 72.0), (0.1, 0.0, 20.0)):
        before = line.robot.base
        for _ in range(round(seconds / 0.4)):
            driver.drive(forward, turn)
            driver.sleep(0.4)
        driver.stop()
        driver.sleep(0.2)
        motion = driver.loop.take_odometry()
        errors += [motion.dtheta - line.robot.base.turned + before.turned] if turn else []
        errors += [motion.dx - line.robot.base.travelled + before.travelled] if forward else []
    assert driver.active_stop is None
    return abs(math.degrees(errors[0])), abs(errors[1]), driver


@pytest.mark.parametrize(("counts", "wrap"), [(0, 2**16), (65500, 2**16), (100, 2**15)])
def test_the_encoders_of_a_create_2_are_followed_past_their_end(counts, wrap):
    line = emulated(model="create2", counts=counts, wrap=wrap)
    turn, way, _ = turned_and_driven(line, model="create2", wrap=wrap)
    assert turn < 0.3
    assert way < 1e-3
    assert line.robot.unknown == 0


def test_a_lost_reply_of_encoders_loses_no_motion():
    line = emulated(model="create2")
    loop = line.control_loop(model="create2")
    drive(line, loop, 0.5, 0.2)
    line.mangle = lambda reply: b""
    drive(line, loop, 0.1, 0.2)
    line.mangle = lambda reply: reply
    drive(line, loop, 0.4, 0.2)
    loop.poll()
    assert not loop.gap()
    assert loop.take_odometry().dx == pytest.approx(line.robot.base.travelled, abs=1e-3)


def test_what_is_lost_at_each_reading_is_seldom_lost_once_this_is_known():
    turn, way, driver = turned_and_driven(emulated(remainders="lost"))
    assert turn > 350
    assert "check robot create" in driver.loop.counters.doubt
    known = turned_and_driven(emulated(remainders="lost"), remainders="lost")
    assert known[0] < 1
    assert known[1] < 5e-3
    assert known[2].loop.counters.doubt == ""
    scaled = emulated(remainders="lost", distance_scale=0.9, turn_scale=1.2)
    turn, way, _ = turned_and_driven(scaled, remainders="lost", distance_scale=1 / 0.9, turn_scale=1 / 1.2)
    assert turn < 1
    assert way < 5e-3


def test_a_bump_stops_a_robot_whose_counters_are_not_read(line):
    loop = line.control_loop(remainders="lost")
    drive(line, loop, 1.0, 0.1)
    before = loop.take_odometry()
    assert before.dx < 0.02, "the counters wait for the end of the motion"
    line.robot.touch(protocol.Bumps.LEFT)
    drive(line, loop, 0.2, 0.1)
    assert loop.active_stop.reason is StopReason.BUMPED
    assert not rolls(line.robot)
    assert before.dx + loop.take_odometry().dx == pytest.approx(line.robot.base.travelled, abs=1e-3)


def test_the_light_bumpers_of_a_create_2_see_the_walls_on_their_side():
    config = CreateEmulatorConfig(firmware=FirmwareConfig(model="create2"), world=CreateWorldConfig())
    room = Arena("room", 2.0 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), (), np.array([1.0, 1.8, 0.0]))
    line = Line(config, room)
    loop = line.control_loop(model="create2")
    loop.poll()
    light = loop.last_reply.light
    assert len(light) == 6
    assert light[0] > light[1] > light[2] > light[5]
    assert light[0] > 800 > 100 > light[5]
