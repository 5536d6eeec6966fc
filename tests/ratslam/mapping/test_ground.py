"""The ground of known keyframes, the odds of gains on it, and poses that follow odometry over it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ratslam.mapping.ground import (
    BINS,
    NEAR,
    NO_MOTION,
    OUTLIERS,
    Ground,
    Motion,
    PoseHypothesis,
    advance,
    advance_all,
    learn_gain_odds,
)
from ratslam.mapping.ground import REACH as REACH_CELLS
from ratslam.recall.config import RecallConfig, sector_shifts
from tactile.base.se2 import compose
from tests.ratslam.places.alignment_cases import (
    MOTIONS,
    POSES,
    REACH,
    REACH_HEADING,
    SEEDS,
    VARIANCE,
    assert_same_pose,
    ground_at,
    moved_by,
    supposed,
)


def scattered(seed: int, count: int = 40) -> Ground:
    poses = np.random.default_rng(seed).uniform([-0.2, -0.2, -np.pi], [0.2, 0.2, np.pi], (count, 3))
    return ground_at(poses, (0.0, np.pi))


@given(SEEDS)
def test_near_keyframes_claim_poses_within_reach_and_no_others_do(seed: int) -> None:
    ground = scattered(seed)
    found = set(
        zip(*(index.tolist() for index in ground.near(np.zeros(3), REACH, REACH_HEADING)), strict=True)
    )
    for shift in range(2):
        for frame in range(len(ground.poses)):
            x, y, heading = ground.claims(np.array([shift]), np.array([frame]))[0]
            expected = np.hypot(x, y) < REACH and abs(heading) < REACH_HEADING
            assert ((shift, frame) in found) == expected


@given(SEEDS)
def test_the_best_match_is_the_largest_gain_near_by_that_is_better_than_a_new_place(seed: int) -> None:
    ground, random = scattered(seed), np.random.default_rng(seed + 1)
    gain = random.normal(0.0, 2.0, (2, len(ground.poses)))
    near = gain[ground.near(np.zeros(3), REACH, REACH_HEADING)]
    match = ground.best_match(np.zeros(3), gain)
    if match is None:
        assert not (near > 0).any()
    else:
        assert match.gain == gain[match.shift, match.frame] == near.max() > 0
    assert ground.best_match(np.zeros(3), -np.abs(gain)) is None


@given(SEEDS, POSES)
def test_what_is_near_does_not_depend_on_the_frame_of_the_map(seed: int, change: np.ndarray) -> None:
    ground, moved = scattered(seed), moved_by(change, scattered(seed))
    for one, other in zip(ground.near(np.zeros(3), REACH, 1.0), moved.near(change, REACH, 1.0), strict=True):
        np.testing.assert_array_equal(one, other)
    assert moved.places() == pytest.approx(ground.places())


@given(st.integers(1, 6), st.integers(1, 4))
def test_places_are_counted_once(apart: int, visits: int) -> None:
    poses = np.array([[k * 3 * REACH, 0.0, 0.0] for k in range(apart) for _ in range(visits)])
    assert ground_at(poses).places() == pytest.approx(apart)
    assert ground_at(poses[:1]).places() == 1.0
    assert ground_at(poses, (0.0, np.pi)).places() == pytest.approx(2 * apart)


@pytest.mark.parametrize(
    ("recall", "angle", "least"),
    [
        ({"sector_fov": "whiskers"}, np.pi, 0.3),
        ({"sector_fov": "none"}, 0.0, 0.3),
        ({"sector_fov": 6.28, "shifts": 3}, 0.8, 0.48),  # half the turns between two shifts, and more
    ],
)
def test_a_turned_robot_sees_shifted_views(recall: dict, angle: float, least: float) -> None:
    config = RecallConfig.model_validate(recall)
    shifts = sector_shifts(config)
    ground = Ground.of(np.zeros((1, 3)), shifts, 0.05, angle, VARIANCE, NEAR)
    assert ground.reach == pytest.approx(REACH_CELLS * 0.05)
    assert ground.reach_heading == pytest.approx(least)
    assert len(ground.turns) == len(shifts)
    claimed = ground.claims(np.arange(len(shifts)), np.zeros(len(shifts), int))
    expected = compose(np.zeros((len(shifts), 3)), np.array([[0, 0, -k * angle] for k in shifts.tolist()]))
    assert_same_pose(claimed, expected)


GAINS = arrays(np.float64, st.integers(0, 300), elements=st.floats(-30, 30))
MOST = float(np.log((1 - OUTLIERS) / OUTLIERS))


@given(GAINS, GAINS, st.floats(-100, 100))
def test_odds_are_bounded_for_every_gain(true: np.ndarray, false: np.ndarray, gain: float) -> None:
    """Whatever was counted: a view that has changed, or was misread, does not decide alone."""
    odds = learn_gain_odds(true, false)
    assert abs(odds.of(gain)) <= MOST + 1e-9
    assert odds.odds.shape == (BINS,)
    assert abs(odds.expected) <= MOST + 1e-9
    assert (np.diff(odds.odds) >= -1e-12).all()  # a better fit is never evidence against a place


def test_views_that_tell_nothing_have_no_odds() -> None:
    """The control: true and false poses with equal gains."""
    stream = np.random.default_rng(0)
    same = learn_gain_odds(stream.normal(0, 1, 20000), stream.normal(0, 1, 20000))
    better = learn_gain_odds(stream.normal(2, 1, 20000), stream.normal(0, 1, 20000))
    assert same.expected < 0.02 < 1 < better.expected
    prior = learn_gain_odds(np.zeros(0), np.zeros(0))
    assert prior.of(2.0) > 0.5 > -0.5 > prior.of(-1.0)


def test_impossible_gains_do_not_make_the_bins_coarse() -> None:
    """Likelihoods of 0 give gains of hundreds of nats."""
    stream = np.random.default_rng(0)
    true, false = stream.normal(2, 1, 500), stream.normal(0, 1, 500)
    spoilt = learn_gain_odds(true, np.concatenate([false, np.full(50, -708.0)]))
    assert spoilt.of(3.0) > 1 > -1 > spoilt.of(-2.0)


PATHS = st.lists(MOTIONS, min_size=1, max_size=6)


@given(POSES, PATHS)
def test_without_views_a_pose_moves_as_odometry_and_back(pose: np.ndarray, path: list[Motion]) -> None:
    at, expected = supposed(pose), pose
    for moved in path:
        at, gain = advance(ground_at(pose), at, moved, None)
        expected = compose(expected, moved.motion)
        assert gain is None
    assert_same_pose(at.pose, expected)
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


@given(POSES, st.floats(-0.04, 0.04), st.floats(-0.25, 0.25), st.sampled_from([1.5, 0.0, -2.0]))
def test_a_fitting_keyframe_draws_the_pose_to_it(pose: np.ndarray, beside: float, turned: float, fit: float):
    frame = compose(pose, np.array([beside, -beside, turned]))
    at, gain = advance(ground_at(frame), supposed(pose), NO_MOTION, np.full((1, 1), fit))
    assert gain == fit
    share = 0.02**2 / (0.02**2 + np.array([0.04, 0.04, 0.12]) ** 2) if fit > 0 else np.zeros(3)
    assert_same_pose(at.pose, pose + share * np.array([*(frame - pose)[:2], turned]))


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
