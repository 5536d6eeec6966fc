"""Which views of a followed pose count, and by how much."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.ground import LEAVING, NEAR
from ratslam.places.hypotheses import (
    AGAIN,
    AGAIN_SHARE,
    BESIDE,
    BESIDE_SHARE,
    Path,
    keyframe_odds,
)
from tactile.base.se2 import compose, wrap
from tests.ratslam.places.alignment_cases import SEEDS, odds_of, square_loop

LOOP, ODDS = square_loop(), odds_of()


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


def test_a_heading_that_was_not_driven_does_not_mean_that_the_ground_was_left() -> None:
    ground = LOOP.ground
    across = compose(ground.poses[5], np.array([0.0, 0.0, 1.0]))
    away = compose(ground.poses[5], np.array([0.0, 5.0, 0.0]))
    assert keyframe_odds(ground, ODDS, across, np.nan, True) == (BESIDE, True)
    assert keyframe_odds(ground, ODDS, away, np.nan, True) == (LEAVING, False)
    assert keyframe_odds(ground, ODDS, away, np.nan, False) == (0.0, False)


def test_what_is_seen_from_afar_counts_anywhere_within_reach() -> None:
    ground, beside = LOOP.ground, compose(LOOP.ground.poses[5], np.array([0.0, 0.9 * LOOP.ground.reach, 0.0]))
    assert keyframe_odds(ground, ODDS, beside, 3.0, True) == (0.0, True)
    far = ground._replace(near_share=1.0)
    assert keyframe_odds(far, ODDS, beside, 3.0, True) == (ODDS.of(3.0), True)


def test_a_view_of_nothing_and_one_of_keyframes_beyond_reach_decide_nothing() -> None:
    away = compose(LOOP.ground.poses[5], np.array([0.0, 5.0, 0.0]))
    for inside in (True, False):
        assert keyframe_odds(LOOP.ground, ODDS, LOOP.ground.poses[5], None, inside) == (0.0, inside)
        assert keyframe_odds(LOOP.ground, ODDS, away, 3.0, inside) == (0.0, inside)


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


def test_a_robot_that_turns_where_it_stands_or_drives_on_visits_nothing_again() -> None:
    odds = np.full(AGAIN, 1.0)
    poses = np.tile(LOOP.ground.poses[3], (AGAIN, 1))
    poses[:, 2] += np.arange(AGAIN)
    path = Path(poses, odds)
    np.testing.assert_array_equal(path.independent_odds(LOOP.ground), odds)


@pytest.mark.parametrize("count", [Path.odds_beside, Path.independent_odds])
def test_evidence_against_a_path_beside_the_way_counts_less_after_the_first_keyframe(count) -> None:
    lap = LOOP.ground.poses
    across = compose(lap[3:8], np.array([0.0, 0.0, np.pi / 2]))
    poses = np.concatenate([lap[:3], across, lap[8:11]])
    counted = count(Path(poses, np.full(11, -1.0)), LOOP.ground)
    np.testing.assert_array_equal(counted, [-1.0] * 4 + [-BESIDE_SHARE] * 4 + [-1.0] * 3)


def test_headings_are_undriven_on_the_way_where_nobody_drove_there_and_faced_so() -> None:
    driven, away = LOOP.ground.poses[3], np.array([50.0, 0.0, 0.0])
    across = compose(driven, np.array([0.0, 0.0, np.pi / 2]))
    poses = np.stack([driven, across, driven + away, across + away])
    path = Path(poses, np.full(4, -1.0))
    assert path.at_undriven_headings(LOOP.ground).tolist() == [False, True, False, False]


def test_evidence_for_a_path_counts_beside_the_way_and_where_it_comes_again() -> None:
    poses = np.tile(compose(LOOP.ground.poses[3], np.array([0.0, 0.0, np.pi / 2])), (2 * AGAIN, 1))
    odds = np.full(len(poses), 0.5)
    counted = Path(poses, odds).odds_beside(LOOP.ground)
    np.testing.assert_array_equal(counted, odds)
