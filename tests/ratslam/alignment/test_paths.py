"""Which views of a followed pose count, and by how much."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from ratslam.alignment.gain_odds import LEAVING
from ratslam.alignment.paths import BESIDE, NEAR, judge_everywhere, judge_on_the_way
from tactile.base.se2 import compose, wrap
from tests.ratslam.alignment.alignment_cases import SEEDS, odds_of, square_loop

LOOP, ODDS = square_loop(), odds_of()


@given(SEEDS, st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-1.0, 1.0), st.floats(-9, 9))
def test_views_beside_the_driven_way_count_little_and_never_for_the_pose(
    seed: int, x: float, y: float, turn: float, gain: float
) -> None:
    ground, odds = LOOP.ground, ODDS
    keyframe = ground.poses[seed % len(ground.poses)]
    pose = compose(keyframe, np.array([x, y, turn]))
    log_odds, inside = judge_on_the_way(ground, odds, pose, gain, True)
    apart = np.hypot(*(ground.poses[:, :2] - pose[:2]).T)
    turned = np.abs(wrap(ground.poses[:, 2] - pose[2]))
    if ((apart < NEAR * ground.reach) & (turned < NEAR * ground.reach_heading)).any():
        assert (log_odds, inside) == (odds.of(gain), True)
    else:
        assert inside
        assert BESIDE <= log_odds <= 0


def test_a_heading_that_was_not_driven_does_not_mean_that_the_ground_was_left():
    ground = LOOP.ground
    across = compose(ground.poses[5], np.array([0.0, 0.0, 1.0]))
    away = compose(ground.poses[5], np.array([0.0, 5.0, 0.0]))
    assert judge_on_the_way(ground, ODDS, across, np.nan, True) == (BESIDE, True)
    assert judge_on_the_way(ground, ODDS, away, np.nan, True) == (LEAVING, False)
    assert judge_everywhere(ground, ODDS, across, np.nan, True) == (LEAVING, False)
