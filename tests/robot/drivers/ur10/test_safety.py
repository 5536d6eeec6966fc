"""Checks of targets, speeds and states against every limit; the transform between map and arm base."""

import math
import time
from contextlib import closing
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10 import safety
from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.driver_config import SPEED_CAP, ArmConfig, BaseTransformConfig, tcp_heading, tcp_tilt
from robot.drivers.ur10.rtde_process import ArmCommand, CommandThread
from robot.drivers.ur10.safety import NO_STATE, TargetRefused, check_command, check_state, check_target
from robot.drivers.ur10.shared_state import ARM_STATE, SharedState
from tactile.base.se2 import between, wrap

CONFIG = ArmConfig()


def placed(x, y, heading, lift=0.0):
    return CONFIG.placing.tcp_from_pose(np.array([x, y, heading]), lift)


HOME = placed(0.63, 0.45, 0.0)
anything = st.floats(allow_nan=True, allow_infinity=True)
down = st.builds(placed, st.floats(0.02, 1.2), st.floats(0.02, 0.85), st.floats(-4, 4), st.floats(0, 0.2))


def a_state(**fields):
    """A state without faults of an arm at rest at HOME."""
    state = np.zeros((), ARM_STATE)
    state["tcp"], state["safety"], state["runtime"], state["mode"] = HOME, 1, 2, 7
    state["robot"] = state["host"] = 1.0
    for name, value in fields.items():
        state[name] = value
    return state


@given(st.integers(0, 5), st.sampled_from([math.nan, math.inf, -math.inf]), down)
def test_targets_that_are_not_finite_are_refused(where, bad, target):
    check_target(CONFIG, target, HOME)
    target[where] = bad
    for check, *speed in ((check_target,), (safety.plan_move,), (check_command, 0.01)):
        with pytest.raises(TargetRefused):
            check(CONFIG, target, HOME, *speed)


@given(st.sampled_from([0, 1, 2]), st.booleans(), st.floats(1e-5, 10), down)
def test_targets_outside_the_box_are_refused(axis, above, by, target):
    target[axis] = CONFIG.box.high[axis] + by if above else CONFIG.box.low[axis] - by
    with pytest.raises(TargetRefused, match="outside the box"):
        check_target(CONFIG, target, HOME)
    with pytest.raises(TargetRefused, match="bring it in by hand"):
        check_target(CONFIG, HOME, target)


@pytest.mark.parametrize("target", [None, "home", [0.0] * 5, [0.0] * 7, [[0.0] * 6], [], 3, ["x"] * 6])
def test_targets_that_are_not_poses_are_refused(target):
    with pytest.raises(TargetRefused):
        check_target(CONFIG, target, HOME)


def test_a_tilted_tool_is_refused():
    less, more = (
        [*HOME[:3], *Rotation.from_euler("X", np.pi + np.radians(CONFIG.tilt_deg + by)).as_rotvec()]
        for by in (-0.01, 0.01)
    )
    np.testing.assert_array_equal(check_target(CONFIG, less, HOME), less)
    with pytest.raises(TargetRefused, match="lean"):
        check_target(CONFIG, more, HOME)
    with pytest.raises(TargetRefused, match="one turn"):
        check_target(CONFIG, [*HOME[:3], 3 * np.pi, 0, 0], HOME)


@given(st.one_of(anything, st.floats(0, 0.3)), down, down)
def test_planned_speeds_are_within_the_settings(speed, target, start):
    try:
        move = safety.plan_move(CONFIG, target, start, speed)
    except TargetRefused:
        assert not safety.MIN_SPEED <= speed <= CONFIG.speed
        return
    assert safety.MIN_SPEED <= speed <= CONFIG.speed
    assert 0 < move.speed <= SPEED_CAP
    way = np.linalg.norm(target[:3] - start[:3])
    top = min(move.speed, math.sqrt(CONFIG.acceleration * way))  # peak of a triangular speed profile
    assert top <= max(speed, math.sqrt(CONFIG.acceleration * safety.MOVED_ON)) * (1 + 1e-9)
    assert math.isfinite(move.seconds)
    assert move.seconds <= move.most
    np.testing.assert_array_equal(check_command(CONFIG, move.target, start, move.speed), target)


@pytest.mark.parametrize("way", [0.0, 0.0031, 0.0063, 0.02, 0.1])
def test_a_turn_on_a_short_way_takes_no_longer_than_one_on_a_long_way(way):
    start, target = placed(0.6, 0.45, 0.0), placed(0.6 + way, 0.45, np.radians(176))
    move = safety.plan_move(CONFIG, target, start, 0.03)
    assert safety.rotation_angle(start, target) / move.seconds > 0.1  # rad/s
    assert move.most < 120


@given(st.one_of(anything, st.floats(0.0501, 0.3)), down, down)
def test_the_last_check_refuses_faster_commands(speed, target, start):
    assume(np.linalg.norm(target[:3] - start[:3]) > 0.01)
    assume(not 0 < speed <= CONFIG.speed)
    with pytest.raises(TargetRefused):
        check_command(CONFIG, target, start, speed)


def test_settings_above_the_caps_are_refused_and_time_limits_are_wider_for_an_emulator():
    real = {"host": "192.168.1.10"}
    for bad in (
        {"speed": 0.2501}, {"speed": 0.0}, {"speed": math.nan}, {"hz": 100}, {"turn_rate": 1.1},
        {"backoff": 0.2}, {"unknown": 1}, {"box": {"low": [0, 0, 0], "high": [1, 1, 0]}},
        {"box": {"low": [0, 0, 0], "high": [1, -1, 1]}}, real | {"stale": 1.1}, real | {"heartbeat": 1.1},
        real | {"watchdog_hz": 1.9},
    ):  # fmt: skip
        with pytest.raises(ValidationError):
            ArmConfig.model_validate(bad)
    assert ArmConfig(speed=0.25, turn_rate=1.0, backoff=0.05, hz=500).backoff == 0.05
    assert ArmConfig(host="127.0.0.12", stale=60.0, heartbeat=60.0, watchdog_hz=0.1).stale == 60.0
    assert ArmConfig(host="192.168.1.10", stale=1.0, heartbeat=1.0, watchdog_hz=2.0).stale == 1.0


@given(down, st.floats(-3.1, 3.1))
def test_rotation_angle(tool, by):
    after = (Rotation.from_euler("z", by) * Rotation.from_rotvec(tool[3:])).as_rotvec()
    assert safety.rotation_angle(tool, np.array([*tool[:3], *after])) == pytest.approx(abs(by), abs=1e-7)
    assert safety.rotation_angle(tool, tool) == 0


def test_arrival_requires_position_and_rotation():
    target = placed(0.63, 0.45, 3.14159)
    turn = np.radians(CONFIG.arrive_turn_deg)
    for ahead, heading, there in (
        (0.0005, -3.14159, True),
        (0.0, 3.14159 + 0.99 * turn, True),
        (0.00099, 3.14159, True),
        (0.00101, 3.14159, False),
        (0.0, 3.14159 + 1.01 * turn, False),
    ):
        assert safety.at_target(CONFIG, placed(0.63 + ahead, 0.45, heading), target) == there
    assert not safety.at_target(CONFIG, np.full(6, np.nan), target)


@pytest.mark.parametrize("field", ["tcp", "speed", "force", "joints"])
@given(where=st.integers(0, 5), bad=st.sampled_from([math.nan, math.inf, -math.inf]))
def test_a_state_with_one_value_that_is_not_finite(field, where, bad):
    state = a_state()
    state[field][where] = bad
    _, finding = check_state(CONFIG, NO_STATE, state, np.zeros(6))
    assert finding.outcome is SessionOutcome.ARM_MALFORMED


@given(st.lists(st.floats(-1e300, 1e300), min_size=3, max_size=3))
def test_states_outside_the_box(place):
    _, finding = check_state(CONFIG, NO_STATE, a_state(tcp=[*place, *HOME[3:]]), np.zeros(6))
    away = SessionOutcome.ARM_MALFORMED if np.abs(place).max() > safety.REACH else SessionOutcome.OUT_OF_BOX
    assert (finding and finding.outcome) is (None if CONFIG.box.contains(np.array(place)) else away)


@given(st.integers(0, 2**11 - 1))
def test_the_most_severe_safety_bit_is_reported(bits):
    _, finding = check_state(CONFIG, NO_STATE, a_state(safety=bits), np.zeros(6))
    named = [outcome for mask, outcome, _ in safety.SAFETY_BITS if bits & mask]
    assert (finding.outcome if finding else None) is (named[0] if named else None)
    assert bool(finding) == bool(bits & ~0b11)
    assert not bits & 0b11100000 or finding.outcome is SessionOutcome.EMERGENCY_STOP


@given(st.lists(st.booleans(), min_size=1, max_size=12))
def test_a_contact_requires_two_consecutive_states(loads):
    rest = np.array([20.0, -40.0, 10.0, 1.0, 1.0, 1.0])
    watch, before = NO_STATE, False
    for k, loaded in enumerate(loads):
        force = rest + [0, (CONFIG.force_limit + 1) if loaded else CONFIG.force_limit - 1, 0, 0, 0, 0]
        watch, finding = check_state(CONFIG, watch, a_state(robot=k + 1.0, force=force), rest)
        assert (finding and finding.outcome) is (SessionOutcome.CONTACT if loaded and before else None)
        before = loaded


def test_a_controller_clock_that_stands_still():
    watch, _ = check_state(CONFIG, NO_STATE, a_state(robot=2.0), np.zeros(6))
    for robot in (2.0, 1.0):
        finding = check_state(CONFIG, watch, a_state(robot=robot), np.zeros(6))[1]
        assert finding.outcome is SessionOutcome.CLOCK_JUMPED


@given(st.floats(0, 2 * math.pi), st.integers(2, 200), st.floats(0.0001, 0.002))
def test_the_retreat_follows_the_path_back_and_stays_in_the_box(course, count, step):
    states = np.stack([a_state() for _ in range(count)])
    way = np.array([math.cos(course), math.sin(course), 0.0])
    states["tcp"][:, :3] += np.arange(count)[:, None] * step * way
    target = safety.retreat_target(CONFIG, states)
    if target is None:
        assert (count - 1) * step < 0.002
        return
    back = target[:3] - states[-1]["tcp"][:3]
    assert np.linalg.norm(back) <= CONFIG.backoff + 1e-9
    assert CONFIG.box.contains(target)
    ends = states[-1]["tcp"], states[-1]["tcp"] - 0.02 * np.array([*way, 0, 0, 0])
    if all(map(CONFIG.box.contains, ends)):
        np.testing.assert_allclose(back, -CONFIG.backoff * way, atol=1e-9)
    np.testing.assert_array_equal(target[3:], HOME[3:])


number = st.one_of(st.floats(allow_nan=True, allow_infinity=True), st.floats(-1.3, 1.3))
near = st.builds(placed, st.floats(-0.3, 1.6), st.floats(-0.3, 1.2), st.floats(-4, 4), st.floats(-0.2, 0.5))
poses = st.one_of(st.lists(number, min_size=0, max_size=8), near.map(np.ndarray.tolist))
speeds = st.one_of(number, st.floats(0.001, 0.06), st.sampled_from([0.25, 0.2501, 0.05, 0.1, 0.0, -0.05]))


@pytest.fixture(scope="module")
def shared():
    with closing(SharedState()) as shared:
        shared.publish(a_state())
        yield shared


def command_thread(shared):
    """A command thread with a stub of the library's control interface, and its reports to the session."""
    control, reports = Mock(), []
    return CommandThread(CONFIG, shared, control, lambda **fields: reports.append(fields)), control, reports


def moves(control):
    return [call.args for call in control.moveL.call_args_list]


@given(poses, speeds, st.sampled_from(["move", "retreat"]))
def test_no_invalid_move_is_sent_to_the_controller(shared, pose, speed, do):
    thread, control, reports = command_thread(shared)
    thread.execute(ArmCommand(do, 1, tuple(pose), speed, int(shared.control["stops"])))
    if not moves(control):
        (fault,) = reports
        assert fault["say"] == "fault"
        assert thread.held is not None
        thread.execute(ArmCommand("move", 2, tuple(HOME), 0.01, int(shared.control["stops"])))
        assert not moves(control)
        return
    ((target, speed, acceleration, asynchronous),) = moves(control)
    assert (target, len(target)) == (pose, 6)
    assert np.isfinite(target).all()
    assert CONFIG.box.contains(np.array(target))
    assert 0 < speed <= SPEED_CAP
    way = math.dist(target[:3], HOME[:3])
    assert min(speed, math.sqrt(CONFIG.acceleration * way)) <= CONFIG.speed
    assert way <= CONFIG.backoff + 0.002 or do == "move"
    assert (acceleration, asynchronous) == (CONFIG.acceleration, True)


def test_a_stop_revokes_the_orders_before_it(shared):
    thread, control, _ = command_thread(shared)
    order = ArmCommand("move", 1, tuple(HOME), 0.01, int(shared.control["stops"]))
    shared.control["stops"] += 1
    thread.execute(order)
    assert moves(control) == []
    thread.act()  # sends the stop
    thread.execute(order)
    assert moves(control) == []
    thread.execute(order._replace(stops=int(shared.control["stops"])))
    assert len(moves(control)) == 1


def test_the_watchdog_is_reset_only_while_the_heartbeat_is_recent(shared):
    thread, control, _ = command_thread(shared)
    shared.control["heartbeat"] = time.monotonic() + 60  # longer than any delay of this test
    thread.act()
    assert (control.kickWatchdog.call_count, control.stopL.call_count) == (1, 0)
    shared.control["heartbeat"] = time.monotonic() - CONFIG.heartbeat - 0.001
    thread.act()
    assert control.kickWatchdog.call_count == 1


def test_a_stop_is_sent_before_queued_moves(shared):
    thread, control, _ = command_thread(shared)
    stops = int(shared.control["stops"])
    thread.put(ArmCommand("move", 1, tuple(HOME), 0.01, stops))
    shared.control["stops"] += 1
    thread.put(ArmCommand("move", 2, tuple(HOME), 0.02, stops + 1))
    thread.act()
    control.stopL.assert_called_once_with(CONFIG.deceleration, True)
    assert [call[1] for call in moves(control)] == [0.02]
    thread.leaving = True
    thread.put(ArmCommand("move", 3, tuple(HOME), 0.01, stops + 1))
    thread.act()
    assert len(moves(control)) == 1


def test_a_target_without_joint_solution_is_not_sent(shared):
    thread, control, reports = command_thread(shared)
    control.isPoseWithinSafetyLimits.return_value = False
    thread.execute(ArmCommand("move", 1, tuple(HOME), 0.01, int(shared.control["stops"])))
    assert moves(control) == []
    assert [fault["outcome"] for fault in reports] == [SessionOutcome.UNREACHABLE.name]


@pytest.fixture(scope="module")
def stub_arm():
    with Arm(CONFIG) as arm:
        arm.shared.publish(a_state())
        arm.process, arm.armed = Mock(), True
        yield arm, arm.process


@given(poses, st.one_of(st.none(), speeds))
def test_no_invalid_move_is_sent_to_the_rtde_process(stub_arm, pose, speed):
    arm, process = stub_arm
    process.send.reset_mock()
    try:
        move = arm.move(pose, speed)
    except TargetRefused:
        process.send.assert_not_called()
        return
    process.send.assert_called_once()
    order = process.send.call_args.kwargs
    assert order["target"] == pose
    assert np.isfinite(pose).all()
    assert CONFIG.box.contains(np.array(pose))
    assert speed is None or safety.MIN_SPEED <= speed <= CONFIG.speed
    assert 0 < order["speed"] == move.speed <= SPEED_CAP


metres = st.floats(-2, 2)
angles = st.one_of(st.floats(-10, 10), st.sampled_from([0.0, np.pi, -np.pi, np.pi / 2, np.pi - 1e-9, 1e-9]))
map_poses = st.tuples(metres, metres, angles).map(np.array)
placings = st.builds(BaseTransformConfig, x=metres, y=metres, z=metres, yaw_deg=st.floats(-180, 180))


@given(placings, map_poses, metres)
def test_the_tool_points_down_and_poses_round_trip(config, pose, lift):
    tool = config.tcp_from_pose(pose, lift)
    assert tcp_tilt(tool) < 1e-6
    back, height = config.pose_from_tcp(tool)
    np.testing.assert_allclose(back[:2], pose[:2], atol=1e-12)
    assert abs(wrap(back[2] - pose[2])) < 1e-9
    assert -np.pi < back[2] <= np.pi
    np.testing.assert_allclose(height, lift, atol=1e-12)


@given(placings, map_poses, map_poses)
def test_motions_in_the_map_are_motions_of_the_tool(config, a, b):
    tools = config.tcp_from_pose(np.stack([a, b]))
    seen = np.concatenate([tools[:, :2], tcp_heading(tools)[:, None]], axis=1)
    moved, meant = between(*seen), between(a, b)
    np.testing.assert_allclose(moved[:2], meant[:2], atol=1e-9)
    assert abs(wrap(moved[2] - meant[2])) < 1e-9


def test_the_rotation_is_rz_times_rx_pi_and_the_tool_points_down():
    poses = np.stack(np.broadcast_arrays(0.1, 0.2, np.linspace(-3, 3, 12).reshape(3, 4)), axis=-1)
    tools = BaseTransformConfig(yaw_deg=0.0).tcp_from_pose(poses, np.zeros((3, 4)))
    pose, lift = BaseTransformConfig(yaw_deg=0.0).pose_from_tcp(tools)
    assert (tools.shape, lift.shape) == ((3, 4, 6), (3, 4))
    np.testing.assert_allclose(pose, poses, atol=1e-9)
    for heading, tool in zip(poses[..., 2].ravel(), tools.reshape(-1, 6), strict=True):
        meant = Rotation.from_euler("z", heading) * Rotation.from_euler("x", np.pi)
        np.testing.assert_allclose(Rotation.from_rotvec(tool[3:]).as_matrix(), meant.as_matrix(), atol=1e-12)


def test_tilt():
    for lean in (0.0, 0.1, 1.0, 3.0):
        turn = Rotation.from_euler("ZX", [0.7, np.pi + lean])
        assert abs(tcp_tilt(np.array([0, 0, 0, *turn.as_rotvec()])) - lean) < 1e-6
        assert abs(wrap(tcp_heading(np.array([0, 0, 0, *turn.as_rotvec()])) - 0.7)) < 1e-9
