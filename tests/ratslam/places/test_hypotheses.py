"""Pose hypotheses have to explain a session from its start; the log-odds of gains in a map, by itself."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ratslam.mapping import ground as grounds
from ratslam.mapping.ground import MAP_WEIGHTING, NEAR, Ground, Motion, PoseHypothesis, less_where_common
from ratslam.places import hypotheses as explaining
from ratslam.places.hypotheses import AGAIN, LONGEST, SHARE, SPAN, Hypotheses, Path, SessionViews
from ratslam.places.localiser import LENGTH, Gains, compare_with_itself
from tactile.base.se2 import compose, wrap
from tests.ratslam.places import alignment_cases as cases

LOOP, ODDS = cases.Loop(), cases.odds_of()
BEGIN, COUNT, GUARD = 7, 30, 20


def session(seed: int = 0) -> tuple[np.ndarray, list[Motion], np.ndarray]:
    """True poses, motions and gains of a session on the loop."""
    truth = LOOP.drive(BEGIN, COUNT, seed)
    return truth, cases.motions_of(truth, 0.005, seed), LOOP.gains(truth, seed)


def recorded(motions: Sequence[Motion], gains: Sequence[np.ndarray | None]) -> SessionViews:
    views = SessionViews(1, len(LOOP.poses))
    for moved, gain in zip(motions, gains, strict=True):
        views.append(moved, gain)
    return views


def followed_back(views: SessionViews, pose: np.ndarray, *least: float) -> Path:
    return views.follow_back(LOOP.ground, ODDS, PoseHypothesis(pose, np.diag(cases.VARIANCE)), *least)


def advanced(known: Hypotheses, views: SessionViews, motions: list[Motion], gains: np.ndarray) -> Hypotheses:
    """The hypotheses after the tenth keyframe and later ones."""
    for moved, gain in zip(motions[10:], gains[10:], strict=True):
        views.append(moved, gain)
        known.advance(LOOP.ground, ODDS, moved, gain, None)
    return known


@settings(max_examples=12)
@given(cases.SEEDS)
def test_the_true_pose_explains_the_session_back_to_its_start_and_others_do_not(seed: int) -> None:
    truth, motions, gains = session(seed)
    views = recorded(motions, gains)
    path = followed_back(views, truth[-1])
    assert len(path.poses) == len(path.odds) == COUNT
    assert np.hypot(*(path.poses[-1] - truth[0])[:2]) < cases.REACH
    assert path.odds[0] == 0  # the view of the newest keyframe proposed the pose
    assert path.odds.sum() > 10
    against = recorded(motions, [np.full_like(gain, -5.0) for gain in gains])
    end = followed_back(against, truth[-1], -6.0)
    assert end.odds.sum() < -6  # a hopeless path is not followed to its end
    assert len(end.poses) < 8
    for k in range(0, len(LOOP.poses), 16):
        if np.hypot(*(LOOP.poses[k] - truth[-1])[:2]) > 0.5:
            assert followed_back(views, LOOP.poses[k]).odds.sum() < path.odds.sum() - 10


def test_leaving_mapped_ground_counts_once_and_only_the_newest_keyframes_are_remembered() -> None:
    away = [Motion(np.array([0.3, 0.0, 0.0]), np.full(3, 1e-6))] * 6
    here = compose(LOOP.poses[10], np.array([0.0, 3.0, 0.0]))
    for gain, odds in ((np.zeros((1, len(LOOP.poses)), np.float32), -2.0), (None, 0.0)):
        assert followed_back(recorded(away, [gain] * 6), here).odds.sum() == odds
    views = SessionViews(1, 2)
    for k in range(2 * SPAN + 5):
        views.append(Motion(np.array([k, 0.0, 0.0]), np.zeros(3)), np.full((1, 2), k, np.float32))
    assert SPAN <= views.count <= 2 * SPAN
    assert views.moved(views.count - 1).motion[0] == 2 * SPAN + 4
    assert (views.gains(views.count - 1) == np.full((1, 2), 2 * SPAN + 4)).all()
    views.forget(0)
    assert views.count == 0
    views.append(Motion(np.zeros(3), np.zeros(3)), None)
    assert views.gains(0) is None


@settings(max_examples=8)
@given(cases.SEEDS, st.permutations([0, 13, 24, 33, 47, 60, 71]))
def test_the_order_of_proposals_does_not_matter(seed: int, order: list[int]) -> None:
    _, motions, gains = session(seed)

    def follow(frames: Sequence[int]) -> np.ndarray:
        known, views = Hypotheses(), recorded(motions[:10], gains[:10])
        for frame in frames:
            known.propose(LOOP.ground, ODDS, views, LOOP.poses[frame])
        known = advanced(known, views, motions, gains)
        rows = np.column_stack([known.pose.rows, known.log_odds.rows])
        return rows[np.lexsort(rows.T)]

    np.testing.assert_array_equal(follow(sorted(order)), follow(order))


def test_of_two_poses_that_become_one_the_likelier_remains_and_hopeless_ones_are_dropped() -> None:
    truth, motions, gains = session()
    known, views = Hypotheses(), recorded(motions[:10], gains[:10])
    beside = compose(truth[9], np.array([1.05 * cases.REACH, 0.0, 0.0]))
    for pose in (beside, truth[9], truth[9]):
        known.propose(LOOP.ground, ODDS, views, pose)
    assert known.count == 2  # the third is like the second
    assert advanced(known, views, motions, gains).count == 1
    assert np.hypot(*(known.at(0).pose - truth[-1])[:2]) < cases.REACH
    assert 0 <= known.fall(0) < known.log_odds.rows[0] / 2
    known, views, ground = Hypotheses(), SessionViews(1, 1), cases.ground_at(np.zeros(3))
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
    for one, of in ((known, views), (again, seen)):
        advanced(one, of, motions, gains).propose(LOOP.ground, ODDS, of, LOOP.poses[70])
        advanced(one, of, motions, gains)
    np.testing.assert_equal([again.arrays(), seen.arrays()], [known.arrays(), views.arrays()])


def uncertain(pose: np.ndarray, deviation: float) -> PoseHypothesis:
    return PoseHypothesis(pose, np.diag([deviation**2, deviation**2, 0.01]))


def test_a_recalled_pose_continues_one_that_odometry_has_made_uncertain() -> None:
    known, sure, here = Hypotheses(), Hypotheses(), compose(LOOP.poses[5], np.array([0.1, 0.0, 0.0]))
    at = uncertain(LOOP.poses[5], 0.2)
    known.add(at, 20.0)
    known.continue_uncertain(LOOP.ground, ODDS, (here, 3.0))
    assert known.count == 2
    cases.assert_same_pose(known.pose.rows[1], here)
    expected = 20.0 + at.log_share(LOOP.ground, here) + ODDS.of(3.0)
    assert known.log_odds.rows[1] == expected < 20.0 + ODDS.of(3.0)
    sure.continue_uncertain(LOOP.ground, ODDS, (LOOP.poses[30], 3.0))
    sure.add(uncertain(LOOP.poses[5], 0.01), 20.0)
    sure.continue_uncertain(LOOP.ground, ODDS, (here, 3.0))
    assert sure.count == 1  # no pose was uncertain


@pytest.mark.parametrize(("log_odds", "likelier"), [(3.0, True), (50.0, False)])
def test_a_pose_that_is_known_already_takes_the_log_odds_of_the_likelier_way_there(log_odds, likelier):
    known = Hypotheses()
    known.add(uncertain(LOOP.poses[5], 0.2), 20.0)
    known.add(uncertain(LOOP.poses[8], 0.01), log_odds)
    known.continue_uncertain(LOOP.ground, ODDS, (LOOP.poses[8], 3.0))
    first, second = known.log_odds.rows
    assert first == 20.0
    assert second > log_odds if likelier else second == log_odds


@given(cases.SEEDS, st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-1.0, 1.0), st.floats(-9, 9))
def test_views_beside_the_driven_way_count_little_and_never_for_the_pose(seed, x, y, turn, gain):
    ground = LOOP.ground
    pose = compose(ground.poses[seed % len(ground.poses)], np.array([x, y, turn]))
    log_odds, inside = explaining.keyframe_odds(ground, ODDS, pose, gain, True)
    apart = np.hypot(*(ground.poses[:, :2] - pose[:2]).T)
    turned = np.abs(wrap(ground.poses[:, 2] - pose[2]))
    assert inside
    near = ((apart < NEAR * ground.reach) & (turned < NEAR * ground.reach_heading)).any()
    assert log_odds == ODDS.of(gain) if near else explaining.BESIDE <= log_odds <= 0


@pytest.mark.parametrize(
    ("off", "gain", "before", "expected"),
    [
        ((0.0, 0.0, 1.0), np.nan, True, (explaining.BESIDE, True)),  # a heading that was not driven
        ((0.0, 5.0, 0.0), np.nan, True, (grounds.LEAVING, False)),  # the ground was left
        ((0.0, 5.0, 0.0), np.nan, False, (0.0, False)),
        ((0.0, 0.9 * cases.REACH, 0.0), 3.0, True, (0.0, True)),  # beside the way
        ((0.0, 0.0, 0.0), None, True, (0.0, True)),  # a view of nothing
        ((0.0, 0.0, 0.0), None, False, (0.0, False)),
        ((0.0, 5.0, 0.0), 3.0, True, (0.0, True)),  # keyframes beyond reach
        ((0.0, 5.0, 0.0), 3.0, False, (0.0, False)),
    ],
)
def test_a_view_away_from_the_way_decides_nothing_but_that_the_ground_was_left(off, gain, before, expected):
    pose = compose(LOOP.ground.poses[5], np.array(off))
    assert explaining.keyframe_odds(LOOP.ground, ODDS, pose, gain, before) == expected
    far = LOOP.ground._replace(near_share=1.0)  # what is seen from afar counts anywhere within reach
    if off[1] == 0.9 * cases.REACH:
        assert explaining.keyframe_odds(far, ODDS, pose, gain, before) == (ODDS.of(gain), True)


@given(cases.SEEDS, st.integers(1, 3))
def test_evidence_for_a_path_counts_half_where_it_comes_again(seed: int, laps: int) -> None:
    lap, count = LOOP.poses, len(LOOP.poses)
    odds = np.random.default_rng(seed).normal(0.5, 1.0, laps * count)
    counted = Path(np.tile(lap, (laps, 1)), odds).independent_odds(LOOP.ground)
    np.testing.assert_array_equal(counted[: count - AGAIN], odds[: count - AGAIN])
    later = odds[count + AGAIN :]
    later = np.where(later > 0, explaining.AGAIN_SHARE * later, later)
    np.testing.assert_array_equal(counted[count + AGAIN :], later)


@pytest.mark.parametrize("count", [Path.odds_beside, Path.independent_odds])
def test_evidence_against_a_path_counts_less_beside_the_way_and_where_nobody_faced_so(count) -> None:
    across = compose(LOOP.poses[3:8], np.array([0.0, 0.0, np.pi / 2]))
    poses = np.concatenate([LOOP.poses[:3], across, LOOP.poses[8:11]])
    counted = count(Path(poses, np.full(11, -1.0)), LOOP.ground)
    np.testing.assert_array_equal(counted, [-1.0] * 4 + [-explaining.BESIDE_SHARE] * 4 + [-1.0] * 3)
    same = np.tile(across[:1], (2 * AGAIN, 1))  # evidence for it counts, and where it comes again
    path = Path(same, np.full(2 * AGAIN, 0.5))
    np.testing.assert_array_equal(path.odds_beside(LOOP.ground), 0.5)
    again = [0.5] * AGAIN + [explaining.AGAIN_SHARE * 0.5] * AGAIN
    np.testing.assert_array_equal(path.independent_odds(LOOP.ground), again)
    poses = np.stack([LOOP.poses[3], across[0], *(np.stack([LOOP.poses[3], across[0]]) + [50.0, 0.0, 0.0])])
    undriven = Path(poses, np.full(4, -1.0)).at_undriven_headings(LOOP.ground)
    assert undriven.tolist() == [False, True, False, False]


def followed(odds: list[float], elsewhere: float = 0.0) -> np.ndarray:
    """The log-odds after each keyframe."""
    states, found = explaining.NOTHING_CHANGED[None], []
    for one in odds:
        states = explaining.continue_states(states, np.array([one]), np.array([elsewhere]))
        found.append(explaining.summed(states)[0])
    return np.array(found)


@pytest.mark.parametrize("strength", [-3.0, -30.0, -3000.0])
def test_a_short_contradiction_costs_its_prior_however_strong_it_is(strength: float) -> None:
    assert followed([1.0] * 50)[-1] == pytest.approx(50.0, abs=0.1)
    found = followed([1.0] * 20 + [strength] * LONGEST + [1.0] * 20)
    assert found[19] - found[-21] == pytest.approx(-np.log(SHARE / LONGEST), abs=0.5)
    assert found[-1] > found[19]


@pytest.mark.parametrize("strength", [-3.0, -30.0])
def test_a_lasting_contradiction_costs_without_end_and_another_place_is_no_changed_ground(strength: float):
    found = followed([strength] * (4 * (LONGEST + 1)))
    assert (np.diff(found[:: LONGEST + 1]) < np.log(SHARE) / 2).all()
    odds = [1.0] * 20 + [-3.0] * LONGEST
    assert followed(odds, elsewhere=1.0)[-1] < followed(odds)[-1] - 0.9 * LONGEST


def laps(count: int) -> Ground:
    """A map of a robot that drove along the loop so often."""
    return cases.ground_at(np.concatenate([LOOP.drive(0, len(LOOP.poses), seed) for seed in range(count)]))


def gains_on(ground: Ground, apart: float, reaches: float = 2.0) -> Gains:
    """Views whose gains within so many reaches of their place are higher by so much."""
    count = len(ground.poses)
    gain = np.random.default_rng(0).normal(0, 1, (count, 1, count))
    for k, pose in enumerate(ground.poses):
        gain[k][ground.near(pose, reaches * ground.reach, 0.6)] += apart
    return lambda begin, n: gain[begin : begin + n]


@pytest.mark.parametrize("case", [(MAP_WEIGHTING, 3, 2), (grounds.SESSION_WEIGHTING, 6, 1)])
def test_revisits_raise_the_odds_of_high_gains_and_views_alike_everywhere_do_not(case):
    weighing, apart, reaches = case
    ground, asked, gains = laps(3), [], gains_on(laps(3), apart, reaches)

    def ask(begin: int, count: int) -> np.ndarray:
        asked.append((begin, count))
        return gains(begin, count)

    told = compare_with_itself(ground, GUARD, ask, weighing)
    assert all(begin >= 2 * GUARD and begin + count <= len(ground.poses) for begin, count in asked)
    assert {count for _, count in asked} == {LENGTH}
    alike = compare_with_itself(ground, GUARD, gains_on(ground, 0.0), weighing)
    assert told.expected > 2 * alike.expected
    if weighing is MAP_WEIGHTING:
        assert told.expected > 1
        assert told.of(4.0) > 1 > -1 > told.of(0.0)


@pytest.mark.parametrize("count", [1, GUARD, 2 * GUARD + LENGTH])
def test_a_short_map_keeps_the_prior(count: int) -> None:
    ground = cases.ground_at(laps(2).poses[:count])
    odds = compare_with_itself(ground, GUARD, lambda *_: pytest.fail("nothing to compare"), MAP_WEIGHTING)
    np.testing.assert_equal(odds, grounds.learn_gain_odds(np.zeros(0), np.zeros(0)))


SHAPES = st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 30))


@given(arrays(np.float64, SHAPES, elements=st.floats(-700, 30, width=32)))
def test_gains_are_less_by_a_share_of_the_mean_likelihood(gain: np.ndarray) -> None:
    common = np.log(np.exp(gain).mean(axis=(1, 2), keepdims=True))
    pieces = grounds.PIECE_WEIGHTING.weigh(gain)
    np.testing.assert_allclose(pieces, gain - grounds.PIECE_COMMON * common, atol=1e-9)
    np.testing.assert_allclose(less_where_common(gain), gain - grounds.COMMON * common, atol=1e-9)
    np.testing.assert_array_equal(grounds.SESSION_WEIGHTING.weigh(gain), less_where_common(gain))
    assert less_where_common(gain.astype(np.float32)).dtype == np.float32


def test_odds_are_learned_once_for_each_ground_and_survive_a_checkpoint() -> None:
    learned, restored, other = grounds.LearnedOdds(), grounds.LearnedOdds(), cases.odds_of(3.0)
    assert learned.arrays() == {}
    for key in range(2):
        learned.of((20, 0, key), partial(cases.odds_of, 1.0 + key))
    restored.of((22, 0, 19), lambda: other)
    restored.restore(learned.arrays())
    for one in (learned, restored):
        for key in range(2):
            again = one.of((20, 0, key), lambda: pytest.fail("learned again"))
            np.testing.assert_equal(again, cases.odds_of(1.0 + key))
    restored.restore({})
    assert restored.arrays() == {}
    assert restored.of((20, 0, 0), lambda: other) is other
