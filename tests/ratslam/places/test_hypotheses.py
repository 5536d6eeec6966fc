"""Pose hypotheses have to explain a session from its start; which views count, and what outlives a changed
place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.ground import LEAVING, NEAR, Ground, Motion, PoseHypothesis
from ratslam.places.hypotheses import (
    AGAIN,
    AGAIN_SHARE,
    BESIDE,
    BESIDE_SHARE,
    LONGEST,
    NOTHING_CHANGED,
    SHARE,
    SPAN,
    Hypotheses,
    Path,
    SessionViews,
    continue_states,
    keyframe_odds,
    summed,
)
from tactile.base.se2 import compose, wrap
from tests.ratslam.places.alignment_cases import (
    REACH,
    SEEDS,
    VARIANCE,
    assert_same_pose,
    ground_at,
    motions_of,
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


@settings(max_examples=12)
@given(SEEDS)
def test_the_true_pose_explains_the_session_back_to_its_start_and_others_do_not(seed: int) -> None:
    truth, motions, gains = session(seed)
    views = recorded(motions, gains)
    path = views.follow_back(LOOP.ground, ODDS, PoseHypothesis(truth[-1], np.diag(VARIANCE)))
    assert len(path.poses) == len(path.odds) == COUNT
    assert np.hypot(*(path.poses[-1] - truth[0])[:2]) < REACH
    assert path.odds[0] == 0  # the view of the newest keyframe proposed the pose
    assert path.odds.sum() > 10
    against = recorded(motions, [np.full_like(gain, -5.0) for gain in gains])
    end = against.follow_back(LOOP.ground, ODDS, PoseHypothesis(truth[-1], np.diag(VARIANCE)), -6.0)
    assert end.odds.sum() < -6  # a hopeless path is not followed to its end
    assert len(end.poses) < 8
    for k in range(0, len(LOOP.poses), 16):
        if np.hypot(*(LOOP.poses[k] - truth[-1])[:2]) > 0.5:
            assert total(views, LOOP.poses[k]) < path.odds.sum() - 10


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


@settings(max_examples=8)
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
    sure = Hypotheses()
    sure.continue_uncertain(LOOP.ground, ODDS, (LOOP.poses[30], 3.0))
    sure.add(uncertain(LOOP.poses[5], 0.01), 20.0)
    sure.continue_uncertain(LOOP.ground, ODDS, (here, 3.0))
    assert sure.count == 1  # no pose was uncertain
    assert_same_pose(known.pose.rows[1], here)
    expected = 20.0 + at.log_share(LOOP.ground, here) + ODDS.of(3.0)
    assert known.log_odds.rows[1] == expected < 20.0 + ODDS.of(3.0)


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


@given(SEEDS, st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-1.0, 1.0), st.floats(-9, 9))
def test_views_beside_the_driven_way_count_little_and_never_for_the_pose(
    seed: int, x: float, y: float, turn: float, gain: float
) -> None:
    ground, odds = LOOP.ground, ODDS
    keyframe = ground.poses[seed % len(ground.poses)]
    pose = compose(keyframe, np.array([x, y, turn]))
    log_odds, inside = keyframe_odds(ground, odds, pose, gain, True)
    apart = np.hypot(*(ground.poses[:, :2] - pose[:2]).T)
    turned = np.abs(wrap(ground.poses[:, 2] - pose[2]))
    if ((apart < NEAR * ground.reach) & (turned < NEAR * ground.reach_heading)).any():
        assert (log_odds, inside) == (odds.of(gain), True)
    else:
        assert inside
        assert BESIDE <= log_odds <= 0


@pytest.mark.parametrize(
    ("off", "gain", "before", "expected"),
    [
        ((0.0, 0.0, 1.0), np.nan, True, (BESIDE, True)),  # a heading that was not driven
        ((0.0, 5.0, 0.0), np.nan, True, (LEAVING, False)),  # the ground was left
        ((0.0, 5.0, 0.0), np.nan, False, (0.0, False)),
        ((0.0, 0.9 * REACH, 0.0), 3.0, True, (0.0, True)),  # beside the way
        ((0.0, 0.0, 0.0), None, True, (0.0, True)),  # a view of nothing
        ((0.0, 0.0, 0.0), None, False, (0.0, False)),
        ((0.0, 5.0, 0.0), 3.0, True, (0.0, True)),  # keyframes beyond reach
        ((0.0, 5.0, 0.0), 3.0, False, (0.0, False)),
    ],
)
def test_a_view_away_from_the_way_decides_nothing_but_that_the_ground_was_left(off, gain, before, expected):
    pose = compose(LOOP.ground.poses[5], np.array(off))
    assert keyframe_odds(LOOP.ground, ODDS, pose, gain, before) == expected
    far = LOOP.ground._replace(near_share=1.0)  # what is seen from afar counts anywhere within reach
    if off[1] == 0.9 * REACH:
        assert keyframe_odds(far, ODDS, pose, gain, before) == (ODDS.of(gain), True)


@given(SEEDS, st.integers(1, 3))
def test_evidence_for_a_path_counts_half_where_it_comes_again(seed: int, laps: int) -> None:
    random = np.random.default_rng(seed)
    lap = LOOP.ground.poses
    odds = random.normal(0.5, 1.0, laps * len(lap))
    path = Path(np.tile(lap, (laps, 1)), odds)
    counted = path.independent_odds(LOOP.ground)
    first = len(lap) - AGAIN
    np.testing.assert_array_equal(counted[:first], odds[:first])
    later = odds[len(lap) + AGAIN :]
    expected = np.where(later > 0, AGAIN_SHARE * later, later)
    np.testing.assert_array_equal(counted[len(lap) + AGAIN :], expected)


@pytest.mark.parametrize("count", [Path.odds_beside, Path.independent_odds])
def test_evidence_against_a_path_beside_the_way_counts_less_after_the_first_keyframe(count) -> None:
    lap = LOOP.ground.poses
    across = compose(lap[3:8], np.array([0.0, 0.0, np.pi / 2]))
    poses = np.concatenate([lap[:3], across, lap[8:11]])
    counted = count(Path(poses, np.full(11, -1.0)), LOOP.ground)
    np.testing.assert_array_equal(counted, [-1.0] * 4 + [-BESIDE_SHARE] * 4 + [-1.0] * 3)
    same = np.tile(across[:1], (2 * AGAIN, 1))  # evidence for it counts, and where it comes again
    path = Path(same, np.full(2 * AGAIN, 0.5))
    np.testing.assert_array_equal(path.odds_beside(LOOP.ground), 0.5)
    again = [0.5] * AGAIN + [AGAIN_SHARE * 0.5] * AGAIN
    np.testing.assert_array_equal(path.independent_odds(LOOP.ground), again)


def test_headings_are_undriven_on_the_way_where_nobody_drove_there_and_faced_so() -> None:
    driven, away = LOOP.ground.poses[3], np.array([50.0, 0.0, 0.0])
    across = compose(driven, np.array([0.0, 0.0, np.pi / 2]))
    poses = np.stack([driven, across, driven + away, across + away])
    path = Path(poses, np.full(4, -1.0))
    assert path.at_undriven_headings(LOOP.ground).tolist() == [False, True, False, False]


def followed(odds: list[float], elsewhere: float = 0.0) -> np.ndarray:
    """The log-odds after each keyframe."""
    states, found = NOTHING_CHANGED[None], []
    for one in odds:
        states = continue_states(states, np.array([one]), np.array([elsewhere]))
        found.append(summed(states)[0])
    return np.array(found)


@pytest.mark.parametrize("strength", [-3.0, -30.0, -3000.0])
def test_a_short_contradiction_costs_its_prior_however_strong_it_is(strength: float) -> None:
    assert followed([1.0] * 50)[-1] == pytest.approx(50.0, abs=0.1)
    found = followed([1.0] * 20 + [strength] * LONGEST + [1.0] * 20)
    assert found[19] - found[-21] == pytest.approx(-np.log(SHARE / LONGEST), abs=0.5)
    assert found[-1] > found[19]


@pytest.mark.parametrize("strength", [-3.0, -30.0])
def test_a_lasting_contradiction_costs_without_end(strength: float) -> None:
    found = followed([strength] * (4 * (LONGEST + 1)))
    falls = -np.diff(found[:: LONGEST + 1])
    assert (falls > -np.log(SHARE) / 2).all()


def test_views_of_another_place_do_not_pass_for_changed_ground() -> None:
    odds = [1.0] * 20 + [-3.0] * LONGEST
    assert followed(odds, elsewhere=1.0)[-1] < followed(odds)[-1] - 0.9 * LONGEST
