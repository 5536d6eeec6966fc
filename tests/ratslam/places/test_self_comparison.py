"""The log-odds of gains in a map, by comparing it with itself: weighed, and learned once for each ground."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ratslam.mapping.ground import (
    COMMON,
    MAP_WEIGHTING,
    PIECE_COMMON,
    PIECE_WEIGHTING,
    SESSION_WEIGHTING,
    Ground,
    LearnedOdds,
    learn_gain_odds,
    less_where_common,
)
from ratslam.places.localiser import LENGTH, Gains, compare_with_itself
from tests.ratslam.places.alignment_cases import ground_at, odds_of, square_loop

GUARD = 20
LOOP = square_loop()


def laps(count: int) -> Ground:
    """A map of a robot that drove along the loop so often."""
    return ground_at(np.concatenate([LOOP.drive(0, len(LOOP.poses), seed) for seed in range(count)]))


def gains_on(ground: Ground, apart: float, seed: int = 0, reaches: float = 2.0) -> Gains:
    """Views whose gains within so many reaches of their place are higher by so much."""
    count = len(ground.poses)
    stream, gain = np.random.default_rng(seed), np.zeros((count, 1, count))
    for k, pose in enumerate(ground.poses):
        gain[k, 0] = stream.normal(0, 1, count)
        gain[k][ground.near(pose, reaches * ground.reach, 0.6)] += apart
    return lambda begin, n: gain[begin : begin + n]


@pytest.mark.parametrize(("weighing", "apart", "reaches"), [(MAP_WEIGHTING, 3, 2), (SESSION_WEIGHTING, 6, 1)])
def test_revisits_raise_the_odds_of_high_gains_and_views_alike_everywhere_do_not(weighing, apart, reaches):
    ground, asked = laps(3), []
    gains = gains_on(ground, apart, reaches=reaches)

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
    ground = ground_at(laps(2).poses[:count])
    odds = compare_with_itself(ground, GUARD, lambda *_: pytest.fail("nothing to compare"), MAP_WEIGHTING)
    prior = learn_gain_odds(np.zeros(0), np.zeros(0))
    np.testing.assert_array_equal(odds.odds, prior.odds)
    assert odds.expected == prior.expected


GAINS = arrays(
    np.float64,
    st.tuples(st.integers(1, 3), st.integers(1, 4), st.integers(1, 30)),
    elements=st.floats(-700, 30, width=32),
)


@given(GAINS)
def test_gains_are_less_by_a_share_of_the_mean_likelihood(gain: np.ndarray) -> None:
    common = np.log(np.exp(gain).mean(axis=(1, 2), keepdims=True))
    for weigh, share in ((less_where_common, COMMON), (PIECE_WEIGHTING.weigh, PIECE_COMMON)):
        np.testing.assert_allclose(weigh(gain), gain - share * common, atol=1e-9)
    np.testing.assert_array_equal(SESSION_WEIGHTING.weigh(gain), less_where_common(gain))
    assert less_where_common(gain.astype(np.float32)).dtype == np.float32


def test_odds_are_learned_once_for_each_ground_and_survive_a_checkpoint() -> None:
    learned, restored, other = LearnedOdds(), LearnedOdds(), odds_of(3.0)
    assert learned.arrays() == {}
    for key in range(2):
        learned.of((20, 0, key), partial(odds_of, 1.0 + key))
    restored.of((22, 0, 19), lambda: other)
    restored.restore(learned.arrays())
    for one in (learned, restored):
        for key in range(2):
            again = one.of((20, 0, key), lambda: pytest.fail("learned again"))
            for array, expected in zip(again, odds_of(1.0 + key), strict=True):
                np.testing.assert_array_equal(array, expected)
    restored.restore({})
    assert restored.arrays() == {}
    assert restored.of((20, 0, 0), lambda: other) is other
