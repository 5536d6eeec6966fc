"""Pose hypotheses move as odometry says, and are corrected by the keyframes near by."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.ground import NO_MOTION, Motion, PoseHypothesis, advance, advance_all
from tactile.base.se2 import compose
from tests.ratslam.places.alignment_cases import (
    MOTIONS,
    POSES,
    REACH,
    REACH_HEADING,
    SEEDS,
    assert_same_pose,
    ground_at,
    moved_by,
    odds_of,
    square_loop,
    supposed,
)

PATHS = st.lists(MOTIONS, min_size=1, max_size=6)


@given(POSES, PATHS)
def test_without_views_a_pose_moves_as_odometry(pose: np.ndarray, path: list[Motion]) -> None:
    at, expected = supposed(pose), pose
    for moved in path:
        at, gain = advance(ground_at(pose), at, moved, None)
        expected = compose(expected, moved.motion)
        assert gain is None
    assert_same_pose(at.pose, expected)


@given(POSES, PATHS)
def test_going_back_undoes_going_forth(pose: np.ndarray, path: list[Motion]) -> None:
    at = supposed(pose)
    for moved in path:
        at = at.moved(moved)
    for moved in reversed(path):
        at = at.moved(moved.reversed())
    assert_same_pose(at.pose, pose)


@given(POSES, PATHS, SEEDS)
def test_the_covariance_stays_symmetric_and_positive(pose: np.ndarray, path: list[Motion], seed: int) -> None:
    stream = np.random.default_rng(seed)
    ground = ground_at(compose(pose, stream.normal(0, 0.2, (30, 3))), (0.0, np.pi))
    at = supposed(pose)
    for moved in path:
        at, _ = advance(ground, at, moved, stream.normal(1, 2, (2, 30)))
        np.testing.assert_allclose(at.covariance, at.covariance.T, rtol=0, atol=1e-15)
        assert np.linalg.eigvalsh(at.covariance).min() > 0
        assert -np.pi <= at.pose[2] <= np.pi


@given(st.lists(POSES, min_size=1, max_size=5), PATHS, SEEDS)
def test_many_poses_advance_as_each_alone(poses: list[np.ndarray], path: list[Motion], seed: int) -> None:
    stream = np.random.default_rng(seed)
    around = [compose(pose, stream.normal(0, 0.2, (10, 3))) for pose in poses]
    ground = ground_at(np.concatenate(around), (0.0, np.pi))
    alone = [supposed(pose, 0.0) for pose in poses]
    together = PoseHypothesis(np.stack(poses), np.zeros((len(poses), 3, 3)))
    for moved in [NO_MOTION, *path]:
        gain = stream.normal(0, 2, (2, 10 * len(poses)))
        together, gains = advance_all(ground, together, moved, gain)
        pairs = [advance(ground, at, moved, gain) for at in alone]
        alone = [at for at, _ in pairs]
        np.testing.assert_array_equal(gains, [best for _, best in pairs])
        for k, at in enumerate(alone):
            np.testing.assert_array_equal(together.pose[k], at.pose)
            np.testing.assert_array_equal(together.covariance[k], at.covariance)


@given(POSES, MOTIONS)
def test_odometry_adds_uncertainty_and_views_remove_it(pose: np.ndarray, moved: Motion) -> None:
    before = supposed(pose)
    driven = before.moved(moved)
    assert np.trace(driven.covariance) >= np.trace(before.covariance) - 1e-15
    seen, gain = advance(ground_at(driven.pose), before, moved, np.full((1, 1), 2.0))
    assert gain == 2.0
    assert np.trace(seen.covariance) < np.trace(driven.covariance)


@given(POSES, POSES, PATHS, SEEDS)
def test_a_rigid_motion_of_the_whole_map_moves_the_result(
    change: np.ndarray, pose: np.ndarray, path: list[Motion], seed: int
) -> None:
    def follow(start: np.ndarray, frames: np.ndarray) -> tuple[PoseHypothesis, list[float]]:
        stream, at, gains = np.random.default_rng(seed), supposed(start), []
        for moved in path:
            at, gain = advance(ground_at(frames), at, moved, stream.normal(1, 2, (1, 20)))
            gains.append(gain)
        return at, gains

    frames = compose(pose, np.random.default_rng(seed).normal(0, 0.1, (20, 3)))
    (one, gains), (other, same) = follow(pose, frames), follow(compose(change, pose), compose(change, frames))
    np.testing.assert_array_equal(gains, same)
    assert_same_pose(other.pose, compose(change, one.pose))
    cosine, sine = np.cos(change[2]), np.sin(change[2])
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    np.testing.assert_allclose(other.covariance, turn @ one.covariance @ turn.T, atol=1e-12)


@given(POSES, st.floats(-0.04, 0.04), st.floats(-0.25, 0.25))
def test_a_fitting_keyframe_draws_the_pose_to_it(pose: np.ndarray, beside: float, turned: float) -> None:
    frame = compose(pose, np.array([beside, -beside, turned]))
    at, gain = advance(ground_at(frame), supposed(pose), NO_MOTION, np.full((1, 1), 1.5))
    assert gain == 1.5
    share = 0.02**2 / (0.02**2 + np.array([0.04, 0.04, 0.12]) ** 2)
    assert_same_pose(at.pose, pose + share * np.array([*(frame - pose)[:2], turned]))


@given(POSES, st.floats(-3, 0))
def test_keyframes_that_do_not_fit_correct_nothing(pose: np.ndarray, fit: float) -> None:
    frame = compose(pose, np.array([0.03, 0.0, 0.1]))
    at, gain = advance(ground_at(frame), supposed(pose), NO_MOTION, np.full((1, 1), fit))
    assert gain == pytest.approx(fit)
    np.testing.assert_array_equal(at.pose, pose)


@pytest.mark.parametrize(
    ("beside", "deviation", "near"),
    [
        ((1.3 * REACH, 0.0, 0.0), 0.0, False),
        ((1.3 * REACH, 0.0, 0.0), 0.2 * REACH, True),
        ((4 * REACH, 0.0, 0.0), 10 * REACH, False),  # however uncertain
        ((0.0, 0.0, 1.3 * REACH_HEADING), 0.0, False),
        ((0.0, 0.0, 1.3 * REACH_HEADING), 0.2 * REACH_HEADING, True),
        ((0.0, 0.0, 3 * REACH_HEADING), 10 * REACH_HEADING, False),
    ],
)
def test_an_uncertain_pose_is_compared_with_more(
    beside: tuple[float, ...], deviation: float, near: bool
) -> None:
    _, gain = advance(
        ground_at(np.array(beside)), supposed(np.zeros(3), deviation), NO_MOTION, np.ones((1, 1))
    )
    assert np.isfinite(gain) == near


def test_a_turn_measured_badly_is_made_good() -> None:
    """A robot that turned by 0.5 rad less than it measured, at once, is followed to the right heading, and
    is not if its odometry is believed more than it deserves."""
    loop, odds = square_loop(), odds_of()
    truth = loop.drive(5, 25, seed=0)
    gains = loop.gains(truth, seed=0)

    def error(deviation: float) -> float:
        wrong = Motion(np.array([0.0, 0.0, 0.5]), np.array([1e-6, 1e-6, deviation**2]))
        at = supposed(truth[0]).moved(wrong)
        for k in range(1, 25):
            step = Motion(np.array([0.05, 0.0, 0.0 if k != 15 else np.pi / 2]), np.full(3, 1e-4))
            at, _ = advance(loop.ground, at, step, gains[k])
        return float(np.hypot(*(at.pose - truth[-1])[:2]))

    assert odds.expected > 0
    assert error(0.25) < REACH
    assert error(0.05) > 2 * REACH


def test_moving_the_ground_moves_its_claims() -> None:
    change, loop = np.array([1.0, -2.0, 0.7]), square_loop()
    shift, frame = np.zeros(3, int), np.array([0, 20, 41])
    moved = moved_by(change, loop.ground).claims(shift, frame)
    assert_same_pose(moved, compose(change, loop.ground.claims(shift, frame)))


@given(POSES, POSES)
def test_the_probability_of_a_pose_is_largest_at_it(pose: np.ndarray, known: np.ndarray) -> None:
    ground, at = ground_at(np.zeros((1, 3))), supposed(known)
    assert at.log_share(ground, pose) <= at.log_share(ground, at.pose) + 1e-9
    assert at.log_share(ground, at.pose) < 0


def test_a_supposed_pose_is_comparable_while_its_ground_is_within_reach() -> None:
    ground = ground_at(np.zeros((1, 3)))
    narrow, wide = ((REACH * factor) ** 2 for factor in (1.4, 1.6))
    for variance, expected in ((narrow, True), (wide, False)):
        at = PoseHypothesis(np.zeros(3), np.diag([variance, 1e-6, 1e-6]))
        assert at.is_comparable(ground) is expected
    turned = PoseHypothesis(np.zeros(3), np.diag([1e-6, 1e-6, (1.1 * REACH_HEADING) ** 2]))
    assert not turned.is_comparable(ground)
