"""Log-odds of gains follow from what was counted."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ratslam.mapping.ground import BINS, OUTLIERS, learn_gain_odds
from tests.ratslam.places.alignment_cases import SEEDS

GAINS = arrays(np.float64, st.integers(0, 300), elements=st.floats(-30, 30))
MOST = float(np.log((1 - OUTLIERS) / OUTLIERS))


@given(GAINS, GAINS, st.floats(-100, 100))
def test_odds_are_bounded_for_every_gain(true: np.ndarray, false: np.ndarray, gain: float) -> None:
    """Whatever was counted: a view that has changed, or was misread, does not decide alone."""
    odds = learn_gain_odds(true, false)
    assert abs(odds.of(gain)) <= MOST + 1e-9
    assert odds.odds.shape == (BINS,)
    assert abs(odds.expected) <= MOST + 1e-9


@given(GAINS, GAINS)
def test_a_better_fit_is_never_evidence_against_a_place(true: np.ndarray, false: np.ndarray) -> None:
    assert (np.diff(learn_gain_odds(true, false).odds) >= -1e-12).all()


@given(SEEDS, st.floats(0.5, 3.0))
def test_odds_rise_with_the_gain_where_the_counts_do(seed: int, apart: float) -> None:
    """Normal distributions of one width have a monotone ratio."""
    stream = np.random.default_rng(seed)
    true, false = stream.normal(apart, 1, 20000), stream.normal(0, 1, 20000)
    odds = learn_gain_odds(true, false)
    assert odds.of(apart + 0.5) > odds.of(apart / 2) > odds.of(-0.5)
    assert odds.of(apart / 2) == pytest.approx(0, abs=0.6)  # where both are as likely
    counted = np.linspace(-1, apart + 1, 12)
    assert (np.diff([odds.of(gain) for gain in counted]) > -0.1).all()


@given(GAINS, GAINS, SEEDS)
def test_the_order_of_the_counts_does_not_matter(true: np.ndarray, false: np.ndarray, seed: int) -> None:
    stream = np.random.default_rng(seed)
    one = learn_gain_odds(true, false)
    other = learn_gain_odds(stream.permutation(true), stream.permutation(false))
    np.testing.assert_array_equal(one.edges, other.edges)
    np.testing.assert_array_equal(one.odds, other.odds)


def test_views_that_tell_nothing_have_no_odds() -> None:
    """The control: true and false poses with equal gains."""
    stream = np.random.default_rng(0)
    same = learn_gain_odds(stream.normal(0, 1, 20000), stream.normal(0, 1, 20000))
    better = learn_gain_odds(stream.normal(2, 1, 20000), stream.normal(0, 1, 20000))
    assert same.expected < 0.02 < 1 < better.expected


def test_nothing_counted_leaves_the_prior() -> None:
    prior = learn_gain_odds(np.zeros(0), np.zeros(0))
    assert prior.of(2.0) > 0.5 > -0.5 > prior.of(-1.0)


def test_impossible_gains_do_not_make_the_bins_coarse() -> None:
    """Likelihoods of 0 give gains of hundreds of nats."""
    stream = np.random.default_rng(0)
    true, false = stream.normal(2, 1, 500), stream.normal(0, 1, 500)
    spoilt = learn_gain_odds(true, np.concatenate([false, np.full(50, -708.0)]))
    assert spoilt.of(3.0) > 1 > -1 > spoilt.of(-2.0)
