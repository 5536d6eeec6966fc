"""Odds that are learned once for each ground."""

from __future__ import annotations

import numpy as np

from ratslam.mapping.ground import GainOdds, LearnedOdds, learn_gain_odds


def odds_of(seed: int) -> GainOdds:
    random = np.random.default_rng(seed)
    return learn_gain_odds(random.normal(2.0, 1.0, 200), random.normal(0.0, 1.0, 200))


def never() -> GainOdds:
    raise AssertionError("learned again")


def same(one: GainOdds, other: GainOdds) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def test_odds_are_learned_once_for_each_ground_and_survive_a_checkpoint() -> None:
    learned, restored = LearnedOdds(), LearnedOdds()
    first = learned.of((20, 0, 19), lambda: odds_of(1))
    second = learned.of((21, 0, 20), lambda: odds_of(2))
    assert not same(first, second)
    restored.restore(learned.arrays())
    for one in (learned, restored):
        assert same(one.of((20, 0, 19), never), first)
        assert same(one.of((21, 0, 20), never), second)


def test_a_checkpoint_without_any_has_no_arrays_and_clears_what_was_learned() -> None:
    learned = LearnedOdds()
    assert learned.arrays() == {}
    learned.of((20, 0, 19), lambda: odds_of(1))
    learned.restore({})
    assert learned.arrays() == {}
    assert same(learned.of((20, 0, 19), lambda: odds_of(2)), odds_of(2))
