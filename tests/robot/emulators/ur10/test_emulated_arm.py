"""The emulated arm: geometry against products of matrices, rotations against scipy; motions, walls."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robot.emulators.ur10.emulated_arm import EmulatedArm, MoveL, Profile, StopL, Unreachable, parse_moves
from robot.emulators.ur10.emulator_config import UrEmulatorConfig, WallConfig
from robot.emulators.ur10.kinematics import (
    UR10,
    UR10E,
    Geometry,
    compose_poses,
    invert_pose,
    quaternion,
    rotate_by,
    rotation_between,
    rotation_vector,
)

Floats = tuple[float, ...]
ANGLE = st.floats(-3.1, 3.1)
JOINTS = st.tuples(*[ANGLE] * 6)
POSE = st.tuples(*[st.floats(-2, 2)] * 3, *[st.floats(-1.8, 1.8)] * 3)
ARMS = pytest.mark.parametrize("arm", [UR10, UR10E], ids=["UR10", "UR10e"])


def chain(arm: Geometry, joints: Floats) -> np.ndarray:
    """The flange's frame [4, 4] as a product of one matrix per joint."""
    frame = np.eye(4)
    lengths = (arm.d1, 0, 0, arm.d4, arm.d5, arm.d6), (0, arm.a2, arm.a3, 0, 0, 0)
    for q, d, a, alpha in zip(joints, *lengths, np.radians([90, 0, 0, 90, -90, 0]), strict=True):
        c, s, ca, sa = math.cos(q), math.sin(q), math.cos(alpha), math.sin(alpha)
        step = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        frame = frame @ np.array(step)
    return frame


def frame_of(pose: Floats) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec(np.array(pose[3:])).as_matrix()
    frame[:3, 3] = pose[:3]
    return frame


@ARMS
@given(joints=JOINTS)
def test_forward_kinematics_equal_the_product_of_matrices(arm: Geometry, joints: Floats) -> None:
    np.testing.assert_allclose(frame_of(arm.forward(joints)), chain(arm, joints), atol=1e-9)


@ARMS
@given(joints=JOINTS)
def test_every_solution_reaches_the_pose_and_includes_the_joints(arm: Geometry, joints: Floats) -> None:
    pose = arm.forward(joints)
    found = arm.solutions(pose, joints[5])
    assert 2 <= len(found) <= 8
    for solution in found:
        np.testing.assert_allclose(chain(arm, solution), chain(arm, joints), atol=1e-5)
    nearest = arm.backward(pose, joints)
    assert nearest is not None
    way = chain(arm, nearest) - chain(arm, joints)
    assert np.abs(way).max() < 1e-5
    if abs(math.sin(joints[4])) > 0.01 and abs(math.sin(joints[2])) > 0.01:
        assert np.abs(np.array(nearest) - joints).max() < 1e-4


@ARMS
@given(joints=JOINTS, turns=st.tuples(*[st.sampled_from([-1, 0, 1])] * 6))
def test_the_nearest_joints_stay_within_two_turns(
    arm: Geometry, joints: Floats, turns: tuple[int, ...]
) -> None:
    near = tuple(q + math.tau * n for q, n in zip(joints, turns, strict=True))
    found = arm.backward(arm.forward(joints), near)
    assert found is not None
    assert max(map(abs, found)) <= math.tau


@pytest.mark.parametrize("pose", [(3.0, 0, 0.3, 0, 0, 0), (0, 0, 0.3, math.pi, 0, 0), (math.nan,) * 6])
def test_a_pose_out_of_reach_has_no_solution(pose: Floats) -> None:
    assert UR10.solutions(pose) == []
    assert UR10.backward(pose, (0.0,) * 6) is None


@given(first=POSE, second=POSE)
def test_poses_compose_as_frames_do(first: Floats, second: Floats) -> None:
    np.testing.assert_allclose(
        frame_of(compose_poses(first, second)), frame_of(first) @ frame_of(second), atol=1e-9
    )
    np.testing.assert_allclose(frame_of(invert_pose(first)), np.linalg.inv(frame_of(first)), atol=1e-9)


@given(first=POSE, second=POSE)
def test_a_rotation_between_poses_is_the_shortest(first: Floats, second: Floats) -> None:
    vector = rotation_between(first, second)
    assert math.hypot(*vector) <= math.pi + 1e-12
    arrived = (*first[:3], *rotate_by(first, vector))
    np.testing.assert_allclose(frame_of(arrived)[:3, :3], frame_of(second)[:3, :3], atol=1e-9)


@given(vector=st.tuples(*[st.floats(-10, 10)] * 3))
def test_a_rotation_vector_survives_its_quaternion(vector: Floats) -> None:
    back = np.array(rotation_vector(quaternion(vector)))
    there = Rotation.from_rotvec(np.array(vector))
    assert (there.inv() * Rotation.from_rotvec(back)).magnitude() < 1e-7
    assert np.linalg.norm(back) <= math.pi + 1e-12


DOWN = (math.pi, 0.0, 0.0)
NOWHERE = (3.0, 0.0, 0.3, *DOWN)
SPEED, RATE = st.floats(0.03, 0.5), st.floats(0.05, 5.0)
PLACE = st.tuples(st.floats(0.4, 0.8), st.floats(-0.3, 0.3), st.floats(0.2, 0.5))


def run(arm: EmulatedArm, seconds: float, dt: float = 0.008) -> np.ndarray:
    """Tool pose and speed [T, 12] at every step, until the arm rests or the time has passed."""
    rows = []
    for _ in range(round(seconds / dt)):
        arm.step(dt)
        rows.append([*arm.state.tcp, *arm.state.speed])
        if not arm.busy:
            break
    return np.array(rows)


@given(length=st.floats(1e-4, 10), speed=SPEED, rate=RATE, share=st.floats(0, 1))
def test_speed_profile_limits_and_derivative(length: float, speed: float, rate: float, share: float) -> None:
    profile = Profile(length, speed, rate)
    duration = profile.duration
    assert profile.at(0.0) == (0.0, 0.0)
    assert profile.at(duration) == (length, 0.0)
    assert duration >= length / speed * (1 - 1e-12)
    time, step = share * duration, duration * 1e-6
    (before, _), (here, now), (after, _) = (profile.at(time + d) for d in (-step, 0.0, step))
    assert 0 <= here <= length * (1 + 1e-12)
    assert 0 <= now <= speed * (1 + 1e-9)
    if step < time < duration - step:
        assert (after - before) / (2 * step) == pytest.approx(now, abs=rate * step + 1e-6 * speed)


@settings(max_examples=30)
@given(place=PLACE, heading=st.floats(-1.5, 1.5), speed=SPEED, rate=RATE)
def test_linear_move_is_straight_within_its_limits_and_arrives(
    place: Floats, heading: float, speed: float, rate: float
) -> None:
    config = UrEmulatorConfig()
    arm = EmulatedArm(config)
    start = arm.state.tcp
    goal = (*place, math.pi * math.cos(heading / 2), math.pi * math.sin(heading / 2), 0.0)
    arm.order([MoveL(goal, speed, rate)])
    try:
        rows = run(arm, 120.0)
    except Unreachable:
        assume(False)
    assert not arm.busy
    assert not arm.moving
    np.testing.assert_allclose(arm.state.tcp[:3], goal[:3], atol=1e-12)
    assert math.hypot(*rotation_between(arm.state.tcp, goal)) < 1e-9
    way = np.subtract(goal[:3], start[:3])
    off = rows[:, :3] - start[:3]
    length = np.linalg.norm(way)
    if length > 0:
        along = off @ way / length**2
        np.testing.assert_allclose(off, along[:, None] * way, atol=1e-12)
    fast = np.linalg.norm(rows[:, 6:9], axis=1)
    turning = np.linalg.norm(rows[:, 9:], axis=1)
    assert fast.max() <= speed * (1 + 1e-9)
    assert turning.max() <= speed * config.turn_ratio * (1 + 1e-9)
    assert np.abs(np.diff(fast[:-1], prepend=0.0)).max() <= rate * 0.008 * (1 + 1e-6) + 1e-12


@settings(max_examples=30)
@given(other=PLACE, after=st.floats(0.05, 2.0), rate=st.floats(0.2, 3.0))
def test_a_move_that_replaces_another_has_no_jumps(other: Floats, after: float, rate: float) -> None:
    arm = EmulatedArm(UrEmulatorConfig())
    arm.order([MoveL((0.6, 0.25, 0.3, *DOWN), 0.1, rate)])
    first = run(arm, after)
    arm.order([MoveL((*other, *DOWN), 0.1, rate)])
    try:
        rows = np.concatenate([first, run(arm, 60.0)])
    except Unreachable:
        assume(False)
    np.testing.assert_allclose(rows[-1, :3], other, atol=1e-12)
    jumps = np.linalg.norm(np.diff(rows[:, 6:9], axis=0), axis=1)
    assert jumps.max() <= 2 * rate * 0.008 + 1e-9  # the last step of a move is cut short
    steps = np.linalg.norm(np.diff(rows[:, :3], axis=0), axis=1)
    assert steps.max() <= 0.1 * 0.008 * (1 + 1e-9)


def test_a_stop_brings_the_arm_to_rest() -> None:
    arm = EmulatedArm(UrEmulatorConfig())
    arm.order([MoveL((0.6, 0.3, 0.3, *DOWN), 0.1, 1.0)])
    run(arm, 0.5)
    assert arm.moving
    arm.order([StopL(2.0)])
    rows = run(arm, 1.0)
    assert not arm.moving
    assert not arm.busy
    assert len(rows) * 0.008 <= 0.25


def test_wall_force_is_stiffness_times_penetration() -> None:
    arm = EmulatedArm(UrEmulatorConfig(walls=(WallConfig(axis="x", at=0.65, stiffness=2000.0),)))
    assert arm.force == (0.0,) * 6
    arm.order([MoveL((0.66, 0.0, 0.3, *DOWN), 0.05, 1.0)])
    run(arm, 10.0)
    assert arm.force[0] == pytest.approx(-20.0)
    assert arm.penetration_max == pytest.approx(0.01)
    arm.order([MoveL((0.6, 0.0, 0.3, *DOWN), 0.05, 1.0)])
    run(arm, 10.0)
    assert arm.force[0] == 0.0
    assert arm.penetration_max == pytest.approx(0.01)


def test_an_unreachable_goal_raises_and_the_arm_stands() -> None:
    arm = EmulatedArm(UrEmulatorConfig())
    arm.order([MoveL(NOWHERE, 0.1, 1.0)])
    with pytest.raises(Unreachable):
        arm.step(0.008)
    assert not arm.busy
    arm.order([MoveL((-0.6, 0.0, 0.3, *DOWN), 0.5, 5.0)])  # through the axis of the base
    with pytest.raises(Unreachable):
        run(arm, 10.0)
    assert not arm.moving


def test_the_speed_slider_slows_moves_and_not_stops() -> None:
    arm = EmulatedArm(UrEmulatorConfig())
    arm.scale = 0.1
    arm.order([MoveL((0.6, 0.3, 0.3, *DOWN), 0.2, 1.0)])
    rows = run(arm, 3.0)
    assert np.linalg.norm(rows[:, 6:9], axis=1).max() <= 0.02 * (1 + 1e-9)
    arm.order([StopL(1.0)])
    assert len(run(arm, 1.0)) * 0.008 <= 0.05


def test_linear_moves_are_read_from_a_script() -> None:
    lines = (
        "\tmovel(p[0.6,0.1,1e-05,3.14159,0,0],a=0.5,v=0.1,r=0.02)",
        "sync()",
        "movel(p[1,2,3,4,5,6])",
        "movel(p[1,2],a=1)",
    )
    assert parse_moves("\n".join(lines)) == [
        MoveL((0.6, 0.1, 1e-5, 3.14159, 0.0, 0.0), 0.1, 0.5),
        MoveL((1.0, 2.0, 3.0, 4.0, 5.0, 6.0), 0.25, 1.2),
    ]


@given(text=st.text())
def test_any_text_can_be_read(text: str) -> None:
    parse_moves(text)
    parse_moves(f"movel(p[{text}],a={text})\nstopl({text})")
