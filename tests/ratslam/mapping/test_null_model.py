"""Laws of the null: scores of false sequences, and the odds that follow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.mapping.acceptance import (
    LEAST_SCORE,
    MIN_TRUE,
    PRIOR_COUNT,
    PRIOR_EXCESS,
    PRIOR_KEYFRAMES,
    PRIOR_SEQUENCES,
    TRUE_MEAN,
    estimate_null,
    log_odds,
)

scores = st.lists(st.floats(-20, 200), min_size=1, max_size=40).map(np.array)
weak = st.lists(st.floats(-20, LEAST_SCORE, exclude_max=True), min_size=1, max_size=20).map(np.array)
nulls = st.tuples(st.floats(0.05, 500), st.floats(0.5, 0.9 * TRUE_MEAN))
keyframes = st.integers(1, 3000)


def surely_false(scores):
    return np.ones(len(scores))


@given(weak, keyframes)
def test_without_strong_false_sequences_the_null_is_its_prior(scores, count):
    found = estimate_null(scores, surely_false(scores), count)
    assert found[0] == pytest.approx(PRIOR_SEQUENCES * count / (PRIOR_KEYFRAMES + count))
    assert found[1] == pytest.approx(PRIOR_EXCESS)


@given(scores, keyframes)
def test_true_sequences_leave_the_prior(scores, count):
    found = estimate_null(scores, np.zeros(len(scores)), count)
    assert found[0] == pytest.approx(PRIOR_SEQUENCES * count / (PRIOR_KEYFRAMES + count))
    assert found[1] == pytest.approx(PRIOR_EXCESS)


@given(scores, weak, keyframes)
def test_the_null_depends_on_strong_sequences_alone(scores, weaker, count):
    more = np.concatenate([weaker, scores])
    first, second = (estimate_null(each, surely_false(each), count) for each in (scores, more))
    assert second[0][len(weaker) :] == pytest.approx(first[0])
    assert second[1][len(weaker) :] == pytest.approx(first[1])


@given(scores, keyframes, st.data())
def test_no_sequence_counts_against_itself(scores, count, data):
    """Its null is that of the others, whatever its score and the probability that it is false."""
    k = data.draw(st.integers(0, len(scores) - 1))
    false = np.linspace(0.1, 0.9, len(scores))
    other, likely = scores.copy(), false.copy()
    other[k], likely[k] = 150.0, 1.0
    first, second = estimate_null(scores, false, count), estimate_null(other, likely, count)
    assert second[0][k] == pytest.approx(first[0][k])
    assert second[1][k] == pytest.approx(first[1][k])


@given(st.integers(5, 300), st.floats(0.1, 100))
def test_many_false_sequences_outweigh_the_prior(count, excess):
    scores = np.full(count + 1, LEAST_SCORE + excess)
    found = estimate_null(scores, surely_false(scores), 20 * count)
    assert np.all((0.5 * count < found[0]) & (found[0] < 1.7 * count))
    share = count / (count + PRIOR_COUNT)
    mean = share * excess + (1 - share) * PRIOR_EXCESS
    assert found[1] == pytest.approx(min(mean, TRUE_MEAN))


@given(scores, keyframes)
def test_the_expected_number_of_false_sequences_grows_with_the_session(scores, count):
    false = surely_false(scores)
    assert np.all(estimate_null(scores, false, count + 1)[0] > estimate_null(scores, false, count)[0])


@given(st.floats(0, 100), nulls, st.floats(0, 500))
def test_odds_are_true_over_false_sequences_per_score(score, null, known):
    true = max(known, MIN_TRUE) * np.exp(-score / TRUE_MEAN) / TRUE_MEAN
    false = null[0] * np.exp(-(score - LEAST_SCORE) / null[1]) / null[1]
    expected = np.log(true) - np.log(false)
    assert log_odds(np.array([score]), *null, known)[0] == pytest.approx(expected, abs=1e-9)


@given(st.floats(0, 100), st.floats(0.1, 50), nulls, st.floats(0, 200), st.floats(0, 200))
def test_odds_grow_with_score_and_true_sequences_and_fall_with_false_ones(score, more, null, known, others):
    score = np.array([score])
    odds = log_odds(score, *null, known)
    assert log_odds(score + more, *null, known) > odds
    assert log_odds(score, *null, known + others) >= odds
    assert log_odds(score, null[0] + 1, null[1], known) < odds


@given(st.floats(1, 100), nulls, st.floats(1.01, 3))
def test_stronger_false_sequences_lower_the_odds_of_a_score_above_theirs(above, null, factor):
    score = np.array([LEAST_SCORE + factor * null[1] + above])
    assert log_odds(score, null[0], factor * null[1], 0.0) < log_odds(score, *null, 0.0)


@given(st.floats(0, 100), st.floats(0.1, 50), st.floats(1.1 * TRUE_MEAN, 200))
def test_false_sequences_stronger_than_true_ones_turn_the_order_around(score, more, excess):
    odds = log_odds(np.array([score, score + more]), 20.0, excess, 0.0)
    assert odds[1] < odds[0]
