"""The emulated arm's geometry against products of Denavit-Hartenberg matrices; rotations against scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

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

ANGLE = st.floats(-3.1, 3.1)
JOINTS = st.tuples(*[ANGLE] * 6)
POSE = st.tuples(*[st.floats(-2, 2)] * 3, *[st.floats(-1.8, 1.8)] * 3)
ARMS = pytest.mark.parametrize("arm", [UR10, UR10E], ids=["UR10", "UR10e"])


def chain(arm: Geometry, joints: tuple[float, ...]) -> np.ndarray:
    """The flange's frame [4, 4] as a product of one matrix per joint."""
    frame = np.eye(4)
    lengths = (arm.d1, 0, 0, arm.d4, arm.d5, arm.d6), (0, arm.a2, arm.a3, 0, 0, 0)
    for q, d, a, alpha in zip(joints, *lengths, np.radians([90, 0, 0, 90, -90, 0]), strict=True):
        c, s, ca, sa = math.cos(q), math.sin(q), math.cos(alpha), math.sin(alpha)
        step = [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        frame = frame @ np.array(step)
    return frame


def frame_of(pose: tuple[float, ...]) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_rotvec(np.array(pose[3:])).as_matrix()
    frame[:3, 3] = pose[:3]
    return frame


@ARMS
@given(joints=JOINTS)
def test_forward_kinematics_equal_the_product_of_matrices(arm: Geometry, joints: tuple[float, ...]) -> None:
    np.testing.assert_allclose(frame_of(arm.forward(joints)), chain(arm, joints), atol=1e-9)


@ARMS
@given(joints=JOINTS)
def test_every_solution_reaches_the_pose_and_includes_the_joints(
    arm: Geometry, joints: tuple[float, ...]
) -> None:
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
    arm: Geometry, joints: tuple[float, ...], turns: tuple[int, ...]
) -> None:
    near = tuple(q + math.tau * n for q, n in zip(joints, turns, strict=True))
    found = arm.backward(arm.forward(joints), near)
    assert found is not None
    assert max(map(abs, found)) <= math.tau


@pytest.mark.parametrize("pose", [(3.0, 0, 0.3, 0, 0, 0), (0, 0, 0.3, math.pi, 0, 0), (math.nan,) * 6])
def test_a_pose_out_of_reach_has_no_solution(pose: tuple[float, ...]) -> None:
    assert UR10.solutions(pose) == []
    assert UR10.backward(pose, (0.0,) * 6) is None


@given(first=POSE, second=POSE)
def test_poses_compose_as_frames_do(first: tuple[float, ...], second: tuple[float, ...]) -> None:
    np.testing.assert_allclose(
        frame_of(compose_poses(first, second)), frame_of(first) @ frame_of(second), atol=1e-9
    )
    np.testing.assert_allclose(frame_of(invert_pose(first)), np.linalg.inv(frame_of(first)), atol=1e-9)


@given(first=POSE, second=POSE)
def test_a_rotation_between_poses_is_the_shortest(
    first: tuple[float, ...], second: tuple[float, ...]
) -> None:
    vector = rotation_between(first, second)
    assert math.hypot(*vector) <= math.pi + 1e-12
    arrived = (*first[:3], *rotate_by(first, vector))
    np.testing.assert_allclose(frame_of(arrived)[:3, :3], frame_of(second)[:3, :3], atol=1e-9)


@given(vector=st.tuples(*[st.floats(-10, 10)] * 3))
def test_a_rotation_vector_survives_its_quaternion(vector: tuple[float, float, float]) -> None:
    back = np.array(rotation_vector(quaternion(vector)))
    there = Rotation.from_rotvec(np.array(vector))
    assert (there.inv() * Rotation.from_rotvec(back)).magnitude() < 1e-7
    assert np.linalg.norm(back) <= math.pi + 1e-12
