"""Checks of targets, speeds and states against every limit."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from pydantic import ValidationError

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.driver_config import SPEED_CAP, ArmConfig, BoxConfig
from robot.drivers.ur10.safety import (
    MIN_SPEED,
    MOVED_ON,
    NO_STATE,
    REACH,
    SAFETY_BITS,
    TargetRefused,
    at_target,
    check_command,
    check_state,
    check_target,
    plan_move,
    retreat_target,
    rotation_angle,
)
from robot.drivers.ur10.shared_state import ARM_STATE

CONFIG = ArmConfig()
HOME = CONFIG.placing.tcp_from_pose(np.array([0.63, 0.45, 0.0]))
NORMAL = 1

anything = st.floats(allow_nan=True, allow_infinity=True)
near = st.one_of(anything, st.floats(-1.5, 1.5))
targets = st.lists(near, min_size=6, max_size=6)
down = st.tuples(st.floats(0.02, 1.2), st.floats(0.02, 0.85), st.floats(-4, 4), st.floats(0, 0.2)).map(
    lambda v: CONFIG.placing.tcp_from_pose(np.array(v[:3]), v[3])
)


def a_state(**fields: object) -> np.ndarray:
    """A state without faults of an arm at rest at HOME."""
    state = np.zeros((), ARM_STATE)
    state["tcp"], state["safety"], state["runtime"], state["mode"] = HOME, NORMAL, 2, 7
    state["robot"] = state["host"] = 1.0
    for name, value in fields.items():
        state[name] = value
    return state


@given(targets)
def test_only_finite_targets_in_the_box_with_the_tool_down_pass(target: list[float]) -> None:
    try:
        passed = check_target(CONFIG, target, HOME)
    except TargetRefused:
        return
    assert np.isfinite(passed).all()
    assert CONFIG.box.contains(passed)
    np.testing.assert_array_equal(passed, target)


@given(st.integers(0, 5), st.sampled_from([math.nan, math.inf, -math.inf]), down)
def test_targets_that_are_not_finite_are_refused(where: int, bad: float, target: np.ndarray) -> None:
    check_target(CONFIG, target, HOME)
    target[where] = bad
    for check in (
        lambda: check_target(CONFIG, target, HOME),
        lambda: plan_move(CONFIG, target, HOME),
        lambda: check_command(CONFIG, target, HOME, 0.01),
    ):
        with pytest.raises(TargetRefused):
            check()


@given(st.sampled_from([0, 1, 2]), st.booleans(), st.floats(1e-5, 10), down)
def test_targets_outside_the_box_are_refused(axis: int, above: bool, by: float, target: np.ndarray) -> None:
    target[axis] = CONFIG.box.high[axis] + by if above else CONFIG.box.low[axis] - by
    with pytest.raises(TargetRefused, match="outside the box"):
        check_target(CONFIG, target, HOME)
    with pytest.raises(TargetRefused, match="bring it in by hand"):
        check_target(CONFIG, HOME, target)


@pytest.mark.parametrize("target", [None, "home", [0.0] * 5, [0.0] * 7, [[0.0] * 6], [], 3, ["x"] * 6])
def test_targets_that_are_not_poses_are_refused(target: object) -> None:
    with pytest.raises(TargetRefused):
        check_target(CONFIG, target, HOME)


def test_a_tilted_tool_is_refused() -> None:
    with pytest.raises(TargetRefused, match="lean"):
        check_target(CONFIG, [*HOME[:3], 0.0, 0.0, 0.0], HOME)


@given(st.one_of(anything, st.floats(0, 0.3)), down, down)
def test_planned_speeds_are_within_the_settings(speed: float, target: np.ndarray, start: np.ndarray) -> None:
    try:
        move = plan_move(CONFIG, target, start, speed)
    except TargetRefused:
        assert not MIN_SPEED <= speed <= CONFIG.speed
        return
    assert MIN_SPEED <= speed <= CONFIG.speed
    assert 0 < move.speed <= SPEED_CAP
    way = np.linalg.norm(target[:3] - start[:3])
    top = min(move.speed, math.sqrt(CONFIG.acceleration * way))  # peak of a triangular speed profile
    assert top <= max(speed, math.sqrt(CONFIG.acceleration * MOVED_ON)) * (1 + 1e-9)
    assert math.isfinite(move.seconds)
    assert move.seconds <= move.most
    np.testing.assert_array_equal(check_command(CONFIG, move.target, start, move.speed), target)


@pytest.mark.parametrize("way", [0.0, 0.0031, 0.0063, 0.02, 0.1])
def test_a_turn_on_a_short_way_takes_no_longer_than_one_on_a_long_way(way: float) -> None:
    start = CONFIG.placing.tcp_from_pose(np.array([0.6, 0.45, 0.0]))
    target = CONFIG.placing.tcp_from_pose(np.array([0.6 + way, 0.45, np.radians(176)]))
    move = plan_move(CONFIG, target, start, 0.03)
    assert rotation_angle(start, target) / move.seconds > 0.1  # rad/s
    assert move.most < 120


@given(st.one_of(anything, st.floats(0.0501, 0.3)), down, down)
def test_the_last_check_refuses_faster_commands(speed: float, target: np.ndarray, start: np.ndarray) -> None:
    assume(np.linalg.norm(target[:3] - start[:3]) > 0.01)
    assume(not 0 < speed <= CONFIG.speed)
    with pytest.raises(TargetRefused):
        check_command(CONFIG, target, start, speed)


@pytest.mark.parametrize(
    "bad",
    [
        {"speed": 0.2501},
        {"speed": 0.0},
        {"speed": math.nan},
        {"hz": 100},
        {"turn_rate": 1.1},
        {"backoff": 0.2},
        {"box": {"low": [0, 0, 0], "high": [1, 1, 0]}},
        {"host": "192.168.1.10", "stale": 1.1},
        {"host": "192.168.1.10", "heartbeat": 1.1},
        {"host": "192.168.1.10", "watchdog_hz": 1.9},
        {"unknown": 1},
    ],
)
def test_settings_above_the_caps_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        ArmConfig.model_validate(bad)


def test_time_limits_are_wider_for_an_emulator() -> None:
    assert ArmConfig(host="127.0.0.12", stale=60.0, heartbeat=60.0, watchdog_hz=0.1).stale == 60.0
    assert ArmConfig(host="192.168.1.10", stale=1.0, heartbeat=1.0, watchdog_hz=2.0).stale == 1.0


@given(down, st.floats(-3.1, 3.1))
def test_rotation_angle(tool: np.ndarray, by: float) -> None:
    from scipy.spatial.transform import Rotation

    after = (Rotation.from_euler("z", by) * Rotation.from_rotvec(tool[3:])).as_rotvec()
    assert rotation_angle(tool, np.array([*tool[:3], *after])) == pytest.approx(abs(by), abs=1e-7)
    assert rotation_angle(tool, tool) == 0


def test_arrival_requires_position_and_rotation() -> None:
    target = CONFIG.placing.tcp_from_pose(np.array([0.63, 0.45, 3.14159]))
    turn = np.radians(0.4)
    assert at_target(CONFIG, CONFIG.placing.tcp_from_pose(np.array([0.6305, 0.45, -3.14159])), target)
    assert at_target(CONFIG, CONFIG.placing.tcp_from_pose(np.array([0.63, 0.45, 3.14159 + turn])), target)
    assert not at_target(CONFIG, CONFIG.placing.tcp_from_pose(np.array([0.632, 0.45, 3.14159])), target)
    assert not at_target(
        CONFIG, CONFIG.placing.tcp_from_pose(np.array([0.63, 0.45, 3.14159 + 2 * turn])), target
    )
    assert not at_target(CONFIG, np.full(6, np.nan), target)


def test_good_states_have_no_finding() -> None:
    watch = NO_STATE
    for k in range(5):
        watch, finding = check_state(CONFIG, watch, a_state(robot=k + 1.0), np.zeros(6))
        assert finding is None


@pytest.mark.parametrize("field", ["tcp", "speed", "force", "joints"])
@given(where=st.integers(0, 5), bad=st.sampled_from([math.nan, math.inf, -math.inf]))
def test_a_state_with_one_value_that_is_not_finite(field: str, where: int, bad: float) -> None:
    state = a_state()
    state[field][where] = bad
    _, finding = check_state(CONFIG, NO_STATE, state, np.zeros(6))
    assert finding is not None
    assert finding.outcome is SessionOutcome.ARM_MALFORMED


@given(st.lists(st.floats(-1e300, 1e300), min_size=3, max_size=3))
def test_states_outside_the_box(place: list[float]) -> None:
    _, finding = check_state(CONFIG, NO_STATE, a_state(tcp=[*place, *HOME[3:]]), np.zeros(6))
    if CONFIG.box.contains(np.array(place)):
        assert finding is None
    else:
        assert finding is not None
        away = np.abs(place).max() > REACH
        assert finding.outcome is (SessionOutcome.ARM_MALFORMED if away else SessionOutcome.OUT_OF_BOX)


@given(st.integers(0, 2**11 - 1))
def test_the_most_severe_safety_bit_is_reported(bits: int) -> None:
    _, finding = check_state(CONFIG, NO_STATE, a_state(safety=bits), np.zeros(6))
    named = [outcome for mask, outcome, _ in SAFETY_BITS if bits & mask]
    assert (finding.outcome if finding else None) is (named[0] if named else None)
    assert bool(finding) == bool(bits & ~0b11)
    if bits & 0b11100000:
        assert finding is not None
        assert finding.outcome is SessionOutcome.EMERGENCY_STOP


@given(st.lists(st.booleans(), min_size=1, max_size=12))
def test_a_contact_requires_two_consecutive_states(loads: list[bool]) -> None:
    rest = np.array([20.0, -40.0, 10.0, 1.0, 1.0, 1.0])
    watch, before = NO_STATE, False
    for k, loaded in enumerate(loads):
        force = rest + [0, (CONFIG.force_limit + 1) if loaded else CONFIG.force_limit - 1, 0, 0, 0, 0]
        watch, finding = check_state(CONFIG, watch, a_state(robot=k + 1.0, force=force), rest)
        assert (finding is not None and finding.outcome is SessionOutcome.CONTACT) == (loaded and before)
        before = loaded


def test_a_controller_clock_that_stands_still() -> None:
    watch, _ = check_state(CONFIG, NO_STATE, a_state(robot=2.0), np.zeros(6))
    for robot in (2.0, 1.0):
        _, finding = check_state(CONFIG, watch, a_state(robot=robot), np.zeros(6))
        assert finding is not None
        assert finding.outcome is SessionOutcome.CLOCK_JUMPED


@given(st.floats(0, 2 * math.pi), st.integers(2, 200), st.floats(0.0001, 0.002))
def test_the_retreat_follows_the_path_back_and_stays_in_the_box(
    course: float, count: int, step: float
) -> None:
    states = np.stack([a_state() for _ in range(count)])
    way = np.array([math.cos(course), math.sin(course), 0.0])
    states["tcp"][:, :3] += np.arange(count)[:, None] * step * way
    target = retreat_target(CONFIG, states)
    if target is None:
        assert (count - 1) * step < 0.002
        return
    back = target[:3] - states[-1]["tcp"][:3]
    assert np.linalg.norm(back) <= CONFIG.backoff + 1e-9
    assert CONFIG.box.contains(target)
    if CONFIG.box.contains(states[-1]["tcp"] - 0.02 * np.array([*way, 0, 0, 0])) and CONFIG.box.contains(
        states[-1]["tcp"]
    ):
        np.testing.assert_allclose(back, -CONFIG.backoff * way, atol=1e-9)
    np.testing.assert_array_equal(target[3:], HOME[3:])


def test_an_inverted_box_is_refused() -> None:
    with pytest.raises(ValidationError, match="smaller"):
        BoxConfig(low=(0, 0, 0), high=(1, -1, 1))
