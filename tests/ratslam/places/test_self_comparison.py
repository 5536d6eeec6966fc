"""A map compared with itself gives the log-odds of gains in it."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.ground import MAP_WEIGHTING, Ground, learn_gain_odds
from ratslam.places.localiser import LENGTH, Gains, compare_with_itself
from tests.ratslam.places.alignment_cases import ground_at, square_loop

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


def test_revisits_raise_the_odds_of_high_gains() -> None:
    ground = laps(4)
    odds = compare_with_itself(ground, GUARD, gains_on(ground, 3.0), MAP_WEIGHTING)
    assert odds.expected > 1
    assert odds.of(4.0) > 1 > -1 > odds.of(0.0)


def test_views_that_are_alike_everywhere_have_no_odds() -> None:
    """The control: the same map with views that tell nothing of the place."""
    ground = laps(4)
    alike = compare_with_itself(ground, GUARD, gains_on(ground, 0.0), MAP_WEIGHTING)
    told = compare_with_itself(ground, GUARD, gains_on(ground, 3.0), MAP_WEIGHTING)
    assert alike.expected < 0.5 * told.expected


def test_the_gains_of_later_keyframes_on_earlier_ones_are_asked_for() -> None:
    ground, asked = laps(3), []
    gains = gains_on(ground, 3.0)

    def ask(begin: int, count: int) -> np.ndarray:
        asked.append((begin, count))
        return gains(begin, count)

    compare_with_itself(ground, GUARD, ask, MAP_WEIGHTING)
    assert all(begin >= 2 * GUARD and begin + count <= len(ground.poses) for begin, count in asked)
    assert {count for _, count in asked} == {LENGTH}


@pytest.mark.parametrize("count", [1, 2, GUARD, 2 * GUARD + LENGTH])
def test_a_short_map_keeps_the_prior(count: int) -> None:
    ground = ground_at(laps(2).poses[:count])
    odds = compare_with_itself(ground, GUARD, lambda *_: pytest.fail("nothing to compare"), MAP_WEIGHTING)
    prior = learn_gain_odds(np.zeros(0), np.zeros(0))
    np.testing.assert_array_equal(odds.odds, prior.odds)
    assert odds.expected == prior.expected
