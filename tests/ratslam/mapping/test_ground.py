"""The ground of known keyframes, the odds of gains on it, and poses that follow odometry over it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ratslam.mapping import ground as grounds
from ratslam.mapping.ground import BINS, NEAR, NO_MOTION, OUTLIERS, Ground, Motion, advance, learn_gain_odds
from ratslam.mapping.ground import REACH as REACH_CELLS
from ratslam.recall.config import RecallConfig, sector_shifts
from tactile.base.se2 import compose
from tests.ratslam.places import alignment_cases as cases
from tests.ratslam.places.alignment_cases import POSES, REACH, SEEDS, assert_same_pose, ground_at, supposed


def scattered(seed: int, count: int = 40) -> Ground:
    poses = np.random.default_rng(seed).uniform([-0.2, -0.2, -np.pi], [0.2, 0.2, np.pi], (count, 3))
    return ground_at(poses, (0.0, np.pi))


@given(SEEDS, POSES)
def test_near_keyframes_claim_poses_within_reach_and_no_others_do(seed: int, change: np.ndarray) -> None:
    """Wherever the map lies."""
    ground = scattered(seed)
    moved = ground._replace(poses=compose(change, ground.poses))
    near = np.zeros((2, len(ground.poses)), bool)
    near[moved.near(change, REACH, cases.REACH_HEADING)] = True
    for shift, found in enumerate(near):
        x, y, heading = ground.claims(np.full(40, shift), np.arange(40)).T
        assert found.tolist() == ((np.hypot(x, y) < REACH) & (abs(heading) < cases.REACH_HEADING)).tolist()
    assert moved.places() == pytest.approx(ground.places())


@given(SEEDS)
def test_the_best_match_is_the_largest_gain_near_by_that_is_better_than_a_new_place(seed: int) -> None:
    ground = scattered(seed)
    gain = np.random.default_rng(seed + 1).normal(0.0, 2.0, (2, len(ground.poses)))
    most = gain[ground.near(np.zeros(3), REACH, cases.REACH_HEADING)].max(initial=0.0)
    match = ground.best_match(np.zeros(3), gain)
    assert (match is None) == (most == 0)
    assert match is None or match.gain == gain[match.shift, match.frame] == most
    assert ground.best_match(np.zeros(3), -np.abs(gain)) is None


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
    shifts = sector_shifts(RecallConfig.model_validate(recall))
    ground = Ground.of(np.zeros((1, 3)), shifts, 0.05, angle, cases.VARIANCE, NEAR)
    assert (ground.reach, ground.reach_heading) == pytest.approx((REACH_CELLS * 0.05, least))
    claimed = ground.claims(np.arange(len(ground.turns)), np.zeros(len(shifts), int))
    assert_same_pose(claimed, np.outer(-angle * shifts, [0, 0, 1]))


GAINS = arrays(np.float64, st.integers(0, 300), elements=st.floats(-30, 30))
MOST = float(np.log((1 - OUTLIERS) / OUTLIERS))


@given(GAINS, GAINS, st.floats(-100, 100))
def test_odds_are_bounded_for_every_gain(true: np.ndarray, false: np.ndarray, gain: float) -> None:
    """A view that has changed, or was misread, does not decide alone."""
    odds = learn_gain_odds(true, false)
    assert abs(odds.of(gain)) <= MOST + 1e-9
    assert odds.odds.shape == (BINS,)
    assert abs(odds.expected) <= MOST + 1e-9
    assert (np.diff(odds.odds) >= -1e-12).all()  # a better fit is never evidence against a place


def test_views_that_tell_nothing_have_no_odds_and_impossible_gains_do_not_make_the_bins_coarse() -> None:
    """Likelihoods of 0 give gains of hundreds of nats."""
    stream = np.random.default_rng(0)
    false, same, true = (stream.normal(mean, 1, 20000) for mean in (0, 0, 2))
    assert learn_gain_odds(same, false).expected < 0.02 < 1 < learn_gain_odds(true, false).expected
    prior = learn_gain_odds(np.zeros(0), np.zeros(0))
    assert prior.of(2.0) > 0.5 > -0.5 > prior.of(-1.0)
    spoilt = learn_gain_odds(true[:500], np.concatenate([false[:500], np.full(50, -708.0)]))
    assert spoilt.of(3.0) > 1 > -1 > spoilt.of(-2.0)


PATHS = st.lists(cases.MOTIONS, min_size=1, max_size=6)


@given(POSES, PATHS)
def test_without_views_a_pose_moves_as_odometry_and_back(pose: np.ndarray, path: list[Motion]) -> None:
    at, expected = supposed(pose), pose
    assert np.trace(at.moved(path[0]).covariance) >= np.trace(at.covariance) - 1e-15
    for moved in path:
        at, gain = advance(ground_at(pose), at, moved, None)
        expected = compose(expected, moved.motion)
        assert gain is None
    assert_same_pose(at.pose, expected)
    for moved in reversed(path):
        at = at.moved(moved.reversed())
    assert_same_pose(at.pose, pose)


@given(st.lists(POSES, min_size=1, max_size=5), PATHS, SEEDS, st.sampled_from([0.0, 0.02]))
def test_many_poses_advance_as_each_alone(poses: list, path: list[Motion], seed: int, sd: float) -> None:
    """And their covariances stay symmetric and positive."""
    stream = np.random.default_rng(seed)
    around = [compose(pose, stream.normal(0, 0.2, (10, 3))) for pose in poses]
    ground = ground_at(np.concatenate(around), (0.0, np.pi))
    alone = [supposed(pose, sd) for pose in poses]
    together = grounds.PoseHypothesis(np.stack(poses), np.tile(sd**2 * np.eye(3), (len(poses), 1, 1)))
    for moved in [NO_MOTION, *path]:
        gain = stream.normal(1, 2, (2, 10 * len(poses)))
        together, gains = grounds.advance_all(ground, together, moved, gain)
        alone, best = zip(*(advance(ground, at, moved, gain) for at in alone), strict=True)
        np.testing.assert_array_equal(gains, best)
        for k, at in enumerate(alone):
            np.testing.assert_array_equal(together.pose[k], at.pose)
            np.testing.assert_array_equal(together.covariance[k], at.covariance)
            np.testing.assert_allclose(at.covariance, at.covariance.T, rtol=0, atol=1e-15)
            assert sd == 0 or np.linalg.eigvalsh(at.covariance).min() > 0
            assert -np.pi <= at.pose[2] <= np.pi


@given(POSES, POSES, PATHS, SEEDS)
def test_a_rigid_motion_of_the_whole_map_moves_the_result(change, pose, path, seed):
    frames = compose(pose, np.random.default_rng(seed).normal(0, 0.1, (20, 3)))
    stream = np.random.default_rng(1)
    one, other = supposed(pose), supposed(compose(change, pose))
    for moved in path:
        gains = stream.normal(1, 2, (1, 20))
        one, gain = advance(ground_at(frames), one, moved, gains)
        other, same = advance(ground_at(compose(change, frames)), other, moved, gains)
        np.testing.assert_equal(gain, same)
    assert_same_pose(other.pose, compose(change, one.pose))
    cosine, sine = np.cos(change[2]), np.sin(change[2])
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    np.testing.assert_allclose(other.covariance, turn @ one.covariance @ turn.T, atol=1e-12)


@given(POSES, st.floats(-0.04, 0.04), st.floats(-0.25, 0.25), st.sampled_from([1.5, 0.0, -2.0]))
def test_a_fitting_keyframe_draws_the_pose_to_it(pose: np.ndarray, beside: float, turned: float, fit: float):
    frame = compose(pose, np.array([beside, -beside, turned]))
    at, gain = advance(ground_at(frame), supposed(pose), NO_MOTION, np.full((1, 1), fit))
    assert gain == fit
    assert (np.diag(at.covariance) < np.diag(supposed(pose).covariance)).all() == (fit > 0)
    share = 0.02**2 / (0.02**2 + np.array([0.04, 0.04, 0.12]) ** 2) if fit > 0 else np.zeros(3)
    assert_same_pose(at.pose, pose + share * np.array([*(frame - pose)[:2], turned]))


@pytest.mark.parametrize(("apart", "sd", "near"), [(1.3, 0.0, False), (1.3, 0.2, True), (4, 10, False)])
@pytest.mark.parametrize("reach", [[REACH, 0.0, 0.0], [0.0, 0.0, cases.REACH_HEADING]])
def test_an_uncertain_pose_is_compared_with_more_but_not_however_uncertain(reach, apart, sd, near):
    at = supposed(np.zeros(3), sd * max(reach))
    _, gain = advance(ground_at(apart * np.array(reach)), at, NO_MOTION, np.ones((1, 1)))
    assert np.isfinite(gain) == near


@given(POSES, POSES)
def test_the_probability_of_a_pose_is_largest_at_it(pose: np.ndarray, known: np.ndarray) -> None:
    ground, at = ground_at(np.zeros((1, 3))), supposed(known)
    assert at.log_share(ground, pose) <= at.log_share(ground, at.pose) + 1e-9
    assert at.log_share(ground, at.pose) < 0


@pytest.mark.parametrize(("reaches", "turned", "near"), [(1.4, 0, True), (1.6, 0, False), (0, 1.1, False)])
def test_a_supposed_pose_is_comparable_while_its_ground_is_within_reach(reaches, turned, near):
    spread = np.array([REACH * reaches, 1e-3, cases.REACH_HEADING * turned]) ** 2 + 1e-9
    at = grounds.PoseHypothesis(np.zeros(3), np.diag(spread))
    assert at.is_comparable(ground_at(np.zeros((1, 3)))) is near
