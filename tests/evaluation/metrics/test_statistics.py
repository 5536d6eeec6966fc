"""Intervals of rates."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.metrics.statistics import wilson_interval

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
