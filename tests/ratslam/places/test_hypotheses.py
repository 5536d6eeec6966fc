"""Pose hypotheses have to explain a session from its start."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.ground import Ground, Motion, PoseHypothesis
from ratslam.places.hypotheses import SPAN, Hypotheses, SessionViews
from tactile.base.se2 import compose
from tests.ratslam.places.alignment_cases import (
    POSES,
    REACH,
    SEEDS,
    VARIANCE,
    assert_same_pose,
    ground_at,
    motions_of,
    moved_by,
    odds_of,
    square_loop,
)

LOOP, ODDS = square_loop(), odds_of()
BEGIN, COUNT = 7, 30


def session(seed: int = 0, count: int = COUNT) -> tuple[np.ndarray, list[Motion], np.ndarray]:
    """True poses, motions and gains of a session on the loop."""
    truth = LOOP.drive(BEGIN, count, seed)
    return truth, motions_of(truth, 0.005, seed), LOOP.gains(truth, seed)


def recorded(motions: Sequence[Motion], gains: Sequence[np.ndarray | None]) -> SessionViews:
    views = SessionViews(1, len(LOOP.poses))
    for moved, gain in zip(motions, gains, strict=True):
        views.append(moved, gain)
    return views


def total(views: SessionViews, pose: np.ndarray, ground: Ground = LOOP.ground) -> float:
    path = views.follow_back(ground, ODDS, PoseHypothesis(pose, np.diag(VARIANCE)))
    return float(path.odds.sum())


def table(known: Hypotheses) -> np.ndarray:
    """[h, 4] poses and log-odds, in an order of their own."""
    rows = np.column_stack([known.pose.rows, known.log_odds.rows])
    return rows[np.lexsort(rows.T)]


@settings(max_examples=15)
@given(SEEDS)
def test_the_true_pose_explains_the_session_and_others_do_not(seed: int) -> None:
    truth, motions, gains = session(seed)
    views = recorded(motions, gains)
    true = total(views, truth[-1])
    assert true > 10
    for k in range(0, len(LOOP.poses), 8):
        if np.hypot(*(LOOP.poses[k] - truth[-1])[:2]) > 0.5:
            assert total(views, LOOP.poses[k]) < true - 10


@settings(max_examples=15)
@given(SEEDS)
def test_following_back_ends_where_the_session_began(seed: int) -> None:
    truth, motions, gains = session(seed)
    path = recorded(motions, gains).follow_back(
        LOOP.ground, ODDS, PoseHypothesis(truth[-1], np.diag(VARIANCE))
    )
    assert len(path.poses) == len(path.odds) == COUNT
    assert np.hypot(*(path.poses[-1] - truth[0])[:2]) < REACH
    assert path.odds[0] == 0  # the view of the newest keyframe proposed the pose


def test_a_hopeless_path_is_not_followed_to_its_end() -> None:
    _, motions, gains = session()
    views = recorded(motions, [np.full_like(gain, -5.0) for gain in gains])
    path = views.follow_back(
        LOOP.ground, ODDS, PoseHypothesis(LOOP.poses[BEGIN + COUNT - 1], np.diag(VARIANCE)), -6.0
    )
    assert path.odds.sum() < -6
    assert len(path.poses) < 8


def test_leaving_mapped_ground_counts_once_and_views_of_nothing_do_not() -> None:
    away = [Motion(np.array([0.3, 0.0, 0.0]), np.full(3, 1e-6))] * 6
    here = compose(LOOP.poses[10], np.array([0.0, 3.0, 0.0]))
    views = recorded(away, [np.zeros((1, len(LOOP.poses)), np.float32)] * 6)
    assert total(views, here) == -2.0
    assert total(recorded(away, [None] * 6), here) == 0.0


def test_only_the_newest_keyframes_are_remembered() -> None:
    views = SessionViews(1, 2)
    for k in range(2 * SPAN + 5):
        views.append(Motion(np.array([k, 0.0, 0.0]), np.zeros(3)), np.full((1, 2), k, np.float32))
    assert SPAN <= views.count <= 2 * SPAN
    assert views.moved(views.count - 1).motion[0] == 2 * SPAN + 4
    newest = views.gains(views.count - 1)
    assert newest is not None
    assert (newest == 2 * SPAN + 4).all()
    views.forget(0)
    assert views.count == 0
    views.append(Motion(np.zeros(3), np.zeros(3)), None)
    assert views.gains(0) is None


@settings(max_examples=15)
@given(SEEDS, st.permutations([0, 13, 24, 33, 47, 60, 71]))
def test_the_order_of_proposals_does_not_matter(seed: int, order: list[int]) -> None:
    _, motions, gains = session(seed)

    def follow(frames: Sequence[int]) -> Hypotheses:
        known, views = Hypotheses(), recorded(motions[:10], gains[:10])
        for frame in frames:
            known.propose(LOOP.ground, ODDS, views, LOOP.poses[frame])
        for moved, gain in zip(motions[10:], gains[10:], strict=True):
            views.append(moved, gain)
            known.advance(LOOP.ground, ODDS, moved, gain, None)
        return known

    np.testing.assert_array_equal(table(follow(sorted(order))), table(follow(order)))


@settings(max_examples=15)
@given(SEEDS, POSES)
def test_the_frame_of_the_map_does_not_matter(seed: int, change: np.ndarray) -> None:
    truth, motions, gains = session(seed)

    def follow(ground: Ground, pose: np.ndarray) -> Hypotheses:
        known, views = Hypotheses(), recorded(motions[:10], gains[:10])
        known.propose(ground, ODDS, views, pose)
        for moved, gain in zip(motions[10:], gains[10:], strict=True):
            known.advance(ground, ODDS, moved, gain, None)
        return known

    one = follow(LOOP.ground, truth[9])
    other = follow(moved_by(change, LOOP.ground), compose(change, truth[9]))
    np.testing.assert_allclose(other.log_odds.rows, one.log_odds.rows, atol=1e-6)
    assert_same_pose(other.pose.rows, compose(change, one.pose.rows), 1e-6)


def test_of_two_poses_that_become_one_the_likelier_remains() -> None:
    truth, motions, gains = session()
    known, views = Hypotheses(), recorded(motions[:10], gains[:10])
    beside = compose(truth[9], np.array([1.05 * REACH, 0.0, 0.0]))
    for pose in (beside, truth[9], truth[9]):
        known.propose(LOOP.ground, ODDS, views, pose)
    assert known.count == 2  # the third is like the second
    for moved, gain in zip(motions[10:], gains[10:], strict=True):
        known.advance(LOOP.ground, ODDS, moved, gain, None)
    assert known.count == 1
    assert np.hypot(*(known.at(0).pose - truth[-1])[:2]) < REACH
    assert 0 <= known.fall(0) < known.log_odds.rows[0] / 2


def test_hopeless_poses_are_dropped() -> None:
    known, views = Hypotheses(), SessionViews(1, 1)
    ground = ground_at(np.zeros(3))
    still = Motion(np.zeros(3), np.full(3, 1e-8))
    views.append(still, np.full((1, 1), 2.0))
    known.propose(ground, ODDS, views, np.zeros(3))
    for _ in range(30):
        known.advance(ground, ODDS, still, np.full((1, 1), -4.0), None)
    assert known.count == 0
    known.propose(ground, ODDS, views, np.zeros(3))
    known.clear()
    assert known.count == len(known.ranked()) == 0


def test_restored_hypotheses_and_views_go_on_to_the_same_bits() -> None:
    _, motions, gains = session()
    known, views = Hypotheses(), recorded(motions[:10], gains[:10])
    for frame in (BEGIN + 9, 30, 50):
        known.propose(LOOP.ground, ODDS, views, LOOP.poses[frame])
    again, seen = Hypotheses(), SessionViews(1, len(LOOP.poses))
    again.restore(known.arrays())
    seen.restore(views.arrays())
    for moved, gain in zip(motions[10:], gains[10:], strict=True):
        for one, of in ((known, views), (again, seen)):
            of.append(moved, gain)
            one.advance(LOOP.ground, ODDS, moved, gain, None)
            one.propose(LOOP.ground, ODDS, of, LOOP.poses[70])
    for one, other in ((known, again), (views, seen)):
        expected, found = one.arrays(), other.arrays()
        assert expected.keys() == found.keys()
        for name in expected:
            np.testing.assert_array_equal(found[name], expected[name])


def uncertain(pose: np.ndarray, deviation: float) -> PoseHypothesis:
    return PoseHypothesis(pose, np.diag([deviation**2, deviation**2, 0.01]))


def test_a_recalled_pose_continues_one_that_odometry_has_made_uncertain() -> None:
    known, here = Hypotheses(), compose(LOOP.poses[5], np.array([0.1, 0.0, 0.0]))
    at = uncertain(LOOP.poses[5], 0.2)
    known.add(at, 20.0)
    known.continue_uncertain(LOOP.ground, ODDS, (here, 3.0))
    assert known.count == 2
    assert_same_pose(known.pose.rows[1], here)
    expected = 20.0 + at.log_share(LOOP.ground, here) + ODDS.of(3.0)
    assert known.log_odds.rows[1] == expected < 20.0 + ODDS.of(3.0)


def test_nothing_continues_where_no_pose_is_uncertain() -> None:
    known = Hypotheses()
    for _ in range(2):
        known.continue_uncertain(LOOP.ground, ODDS, (LOOP.poses[30], 3.0))
        known.clear()
        known.add(uncertain(LOOP.poses[5], 0.01), 20.0)
    assert known.count == 1


def test_a_pose_that_is_known_already_takes_the_log_odds_of_the_likelier_way_there() -> None:
    for log_odds, likelier in ((3.0, True), (50.0, False)):
        known, here = Hypotheses(), LOOP.poses[8]
        known.add(uncertain(LOOP.poses[5], 0.2), 20.0)
        known.add(uncertain(here, 0.01), log_odds)
        known.continue_uncertain(LOOP.ground, ODDS, (here, 3.0))
        assert known.count == 2
        assert (known.log_odds.rows[1] > log_odds) == likelier
        assert known.log_odds.rows[1] >= log_odds
        assert known.log_odds.rows[0] == 20.0
