"""Intervals of rates, and the calibration of probabilities."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics.statistics import expected_calibration_error, wilson_interval

law = settings(derandomize=True, deadline=None, max_examples=100)


@pytest.mark.parametrize(
    ("count", "runs", "low", "high"), [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (18, 18, 0.8241, 1.0)]
)
def test_printed_intervals(count, runs, low, high):
    assert wilson_interval(count, runs) == pytest.approx((low, high), abs=1e-4)


@law
@given(st.integers(0, 200), st.integers(1, 200))
def test_an_interval_holds_the_rate_and_mirrors_its_complement(count, runs):
    count = min(count, runs)
    low, high = wilson_interval(count, runs)
    assert 0 <= low <= count / runs <= high <= 1
    assert wilson_interval(runs - count, runs) == pytest.approx((1 - high, 1 - low))
    wider = wilson_interval(0, runs)[1] - wilson_interval(0, runs)[0]
    assert wilson_interval(0, 4 * runs)[1] < wider


def test_nothing_is_known_without_runs():
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_probabilities_are_calibrated_where_they_equal_the_share_of_true():
    half = np.full(20, 0.5)
    assert expected_calibration_error(half, np.arange(20) % 2 == 0) == 0.0
    assert expected_calibration_error(half, np.ones(20, bool)) == 0.5
    random = np.random.default_rng(0)
    probability = random.random(20_000)
    assert expected_calibration_error(probability, random.random(20_000) < probability) < 0.02
    assert expected_calibration_error(probability, random.random(20_000) < probability**2) > 0.1
    assert np.isnan(expected_calibration_error(np.zeros(0), np.zeros(0, bool)))
