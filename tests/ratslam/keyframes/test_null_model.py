"""Laws of the null: scores of false sequences, and the odds that follow."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ratslam.keyframes.closure_odds import (
    LEAST_SCORE,
    MIN_TRUE,
    PRIOR_COUNT,
    PRIOR_EXCESS,
    PRIOR_KEYFRAMES,
    PRIOR_SEQUENCES,
    TRUE_MEAN,
    NullModel,
    estimate_null,
    log_odds,
)

scores = st.lists(st.floats(-20, 200), max_size=40).map(np.array)
weak = st.lists(st.floats(-20, LEAST_SCORE, exclude_max=True), max_size=20).map(np.array)
nulls = st.builds(NullModel, st.floats(0.05, 500), st.floats(0.5, 0.9 * TRUE_MEAN))


keyframes = st.integers(1, 3000)


@given(weak, keyframes)
def test_without_strong_decoys_the_null_is_its_prior(scores, count):
    number = PRIOR_SEQUENCES * count / (PRIOR_KEYFRAMES + count)
    assert estimate_null(scores, count) == NullModel(pytest.approx(number), pytest.approx(PRIOR_EXCESS))


@given(scores, weak, keyframes)
def test_the_null_depends_on_strong_decoys_alone(scores, weaker, count):
    first = estimate_null(scores, count)
    second = estimate_null(np.concatenate([weaker, scores[::-1]]), count)
    assert first.number == second.number
    assert first.excess == pytest.approx(second.excess)


@given(st.integers(5, 300), st.floats(0.1, 100))
def test_many_decoys_outweigh_the_prior(count, excess):
    found = estimate_null(np.full(count, LEAST_SCORE + excess), 20 * count)
    assert 0.5 * count < found.number < 1.7 * count
    share = count / (count + PRIOR_COUNT)
    mean = share * excess + (1 - share) * PRIOR_EXCESS
    assert found.excess == pytest.approx(min(mean, TRUE_MEAN))


@given(scores, keyframes)
def test_the_expected_number_of_decoys_grows_with_the_session(scores, count):
    assert estimate_null(scores, count + 1).number > estimate_null(scores, count).number


@given(st.floats(0, 100), nulls, st.floats(0, 500))
def test_odds_are_true_over_false_sequences_per_score(score, null, known):
    true = max(known, MIN_TRUE) * np.exp(-score / TRUE_MEAN) / TRUE_MEAN
    false = null.number * np.exp(-(score - LEAST_SCORE) / null.excess) / null.excess
    expected = np.log(true) - np.log(false)
    assert log_odds(np.array([score]), null, known)[0] == pytest.approx(expected, abs=1e-9)


@given(st.floats(0, 100), st.floats(0.1, 50), nulls, st.floats(0, 200), st.floats(0, 200))
def test_odds_grow_with_score_and_true_sequences_and_fall_with_decoys(score, more, null, known, others):
    score = np.array([score])
    odds = log_odds(score, null, known)
    assert log_odds(score + more, null, known) > odds
    assert log_odds(score, null, known + others) >= odds
    assert log_odds(score, null._replace(number=null.number + 1), known) < odds


@given(st.floats(1, 100), nulls, st.floats(1.01, 3))
def test_stronger_decoys_lower_the_odds_of_a_score_above_theirs(above, null, factor):
    score = np.array([LEAST_SCORE + factor * null.excess + above])
    assert log_odds(score, null._replace(excess=factor * null.excess), 0.0) < log_odds(score, null, 0.0)


@given(st.floats(0, 100), st.floats(0.1, 50), st.floats(1.1 * TRUE_MEAN, 200))
def test_decoys_stronger_than_true_sequences_turn_the_order_around(score, more, excess):
    odds = log_odds(np.array([score, score + more]), NullModel(20.0, excess), 0.0)
    assert odds[1] < odds[0]
