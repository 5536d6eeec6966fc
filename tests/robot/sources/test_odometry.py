"""Motion from poses and velocities: round trips, and the error of a constant twist."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robot.sources.odometry import MIDPOINT, TURN_THEN_MOVE, from_poses, from_velocities
from tactile.base.se2 import integrate, wrap

STEPS = st.integers(1, 30)
MOTIONS = STEPS.flatmap(lambda n: arrays(np.float64, (n, 3), elements=st.floats(-3, 3)))


@given(MOTIONS)
def test_motions_are_recovered_from_integrated_poses(motions: np.ndarray) -> None:
    motions[0] = 0
    poses = integrate(motions)
    found = from_poses(np.arange(len(motions)) * 0.5, poses)
    np.testing.assert_allclose(found[:, :2], motions[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrap(found[:, 2] - motions[:, 2]), 0, atol=1e-9)
    assert found[0, 3] == 0
    assert (found[1:, 3] == 0.5).all()


@given(MOTIONS, st.sampled_from([MIDPOINT, TURN_THEN_MOVE]))
def test_the_first_row_only_sets_the_clock(velocities: np.ndarray, heading: float) -> None:
    motion = from_velocities(np.arange(len(velocities)) + 7.0, *velocities.T, heading)
    assert (motion[0] == 0).all()
    np.testing.assert_allclose(np.hypot(*motion[1:, :2].T), np.hypot(*velocities[1:, :2].T), atol=1e-12)
    np.testing.assert_array_equal(motion[1:, 2], velocities[1:, 2])


def test_the_mid_heading_closes_a_circle() -> None:
    """Forty steps of 9 degrees: the mid heading has an error of second order, the new one of first order."""
    time = np.arange(41) * 0.5
    turn = np.full(41, np.pi / 10)
    ends = [
        integrate(from_velocities(time, np.full(41, 0.1), 0.0, turn, heading)[:, :3])
        for heading in (MIDPOINT, TURN_THEN_MOVE)
    ]
    radius = 0.1 / (np.pi / 10)
    for poses in ends:
        np.testing.assert_allclose(poses[-1], 0, atol=1e-12)
    across = [float(np.hypot(*poses[20, :2])) for poses in ends]
    assert across[0] == pytest.approx(2 * radius, rel=2e-3)
    offset = [abs(float(poses[20, 0])) for poses in ends]  # half a circle ends straight to the left
    assert offset[0] < 1e-12
    assert offset[1] > 0.04
