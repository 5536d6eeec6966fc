"""Noise and drift estimates: laws, and the two figures that mislead as controls."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.calibration import (
    estimate_drift,
    estimate_noise,
)

SEEDS = st.integers(0, 10_000)


def coloured(seed: int, length: int, coefficient: float = 0.45, channels: int = 3) -> np.ndarray:
    """[length, channels] autoregressive noise with standard deviation 1."""
    white = stream(seed, "noise").standard_normal((length + 100, channels))
    return lfilter([np.sqrt(1 - coefficient**2)], [1, -coefficient], white, axis=0)[100:]


def push(length: int, first: int, last: int, size: float) -> np.ndarray:
    """[length, 1] a contact: rises over the first third, holds, and falls over the last."""
    rise = max((last - first) // 3, 1)
    row = np.arange(length)
    return size * np.clip(np.minimum(row - first, last - row) / rise, 0, 1)[:, None]


@settings(max_examples=15)
@given(SEEDS, st.sampled_from([0.0, 0.45, 0.7]))
def test_it_is_the_marginal_sd_of_coloured_noise(seed: int, coefficient: float) -> None:
    noise = estimate_noise(coloured(seed, 4000, coefficient))
    np.testing.assert_allclose(noise, 1.0, atol=0.12)


@settings(max_examples=15)
@given(SEEDS)
def test_a_hundred_samples_give_it_within_a_third(seed: int) -> None:
    np.testing.assert_allclose(estimate_noise(coloured(seed, 400, channels=3)), 1.0, atol=0.34)


@settings(max_examples=15)
@given(SEEDS, st.floats(1e-6, 1e6), st.floats(-1e3, 1e3))
def test_it_scales_with_the_record_and_ignores_its_level(seed: int, scale: float, level: float) -> None:
    record = coloured(seed, 300)
    moved = estimate_noise(scale * (record + level))
    np.testing.assert_allclose(moved, scale * estimate_noise(record), rtol=1e-6)


@settings(max_examples=15)
@given(SEEDS, st.floats(0.02, 0.6), st.floats(0, 0.4), st.floats(1, 1e5))
def test_one_contact_cannot_fool_it(seed: int, share: float, start: float, size: float) -> None:
    length = 2000
    contact = push(length, int(start * length), int((start + share) * length), size)
    record = coloured(seed, length) + contact
    noise = estimate_noise(record)
    assert (noise > 0.7).all()
    assert (noise < 1.5).all()


def test_the_sd_of_the_record_and_of_its_differences_are_fooled() -> None:
    record = coloured(0, 2000)
    assert (np.diff(record, axis=0).std(axis=0) / np.sqrt(2) < 0.8).all()
    assert ((record + push(2000, 800, 1400, 1000.0)).std(axis=0) > 100).all()


@settings(max_examples=15)
@given(SEEDS)
def test_a_slow_drift_adds_little(seed: int) -> None:
    record = coloured(seed, 2000)
    drift = np.linspace(0, 20, len(record))[:, None]
    np.testing.assert_allclose(estimate_noise(record + drift), estimate_noise(record), rtol=0.05)


def test_channels_are_independent_and_a_constant_one_has_no_noise() -> None:
    record = np.concatenate([coloured(1, 500), np.full((500, 1), 7.0)], axis=1)
    noise = estimate_noise(record)
    assert noise[3] == 0
    np.testing.assert_array_equal(noise[:3], estimate_noise(record[:, :3]))


@settings(max_examples=15)
@given(SEEDS, st.floats(0.02, 0.5))
def test_drift_of_a_random_walk_beneath_noise(seed: int, rate: float) -> None:
    steps = rate * stream(seed, "walk").standard_normal((40_000, 6))
    drift = estimate_drift(coloured(seed, 40_000, channels=6) + np.cumsum(steps, axis=0))
    assert 0.75 * rate < np.median(drift) < 1.3 * rate


@settings(max_examples=15)
@given(SEEDS)
def test_without_drift_it_is_small_and_a_contact_does_not_raise_it(seed: int) -> None:
    record = coloured(seed, 20_000) + push(20_000, 4000, 4400, 1e4)
    assert (estimate_drift(record) < 0.02).all()


@pytest.mark.parametrize("estimate", [estimate_noise, estimate_drift])
def test_short_and_broken_records_are_refused(estimate) -> None:
    with pytest.raises(InputError, match="at least"):
        estimate(np.zeros((20, 3)))
    record = coloured(0, 2000)
    record[5, 1] = np.nan
    with pytest.raises(InputError, match="NaN"):
        estimate(record)
