"""Mean vector and Rayleigh test of tuning curves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from evaluation.cells.head_direction import (
    mean_vector_length,
    peak_rate,
    preferred_direction,
    rayleigh_p,
    rayleigh_z,
)
from evaluation.cells.rate_map import circle_bin, tuning_curves
from tactile.base.random_streams import stream
from tests.evaluation.cells.box_walk import mixed_sums, random_walk

ANGLES = 2 * np.pi * np.arange(36) / 36


def test_walk_shows_the_preferred_headings() -> None:
    sums = mixed_sums(random_walk())
    curves = tuning_curves(sums)
    length = mean_vector_length(curves, sums.heading_seconds)
    # A von Mises curve of sharpness 4 has I1(4)/I0(4) = 0.8635.
    assert_allclose(length[6:8], 0.8635, atol=0.01)
    assert_allclose(preferred_direction(curves, sums.heading_seconds)[6:8], [0.5, 4.0], atol=0.03)
    assert_allclose(length[9], 0, atol=1e-12)
    assert (length[:6] < 0.25).all()


@settings(derandomize=True, max_examples=40, deadline=None)
@given(st.integers(0, 35), st.floats(0.1, 8.0))
def test_turning_the_curve_turns_the_direction_alone(by: int, sharpness: float) -> None:
    curve, seconds = np.exp(sharpness * (np.cos(ANGLES - 0.2) - 1))[None], np.ones(36)
    turned = np.roll(curve, by, axis=1)
    assert_allclose(mean_vector_length(turned, seconds), mean_vector_length(curve, seconds))
    moved = preferred_direction(turned, seconds) - 0.2 - 2 * np.pi * by / 36
    assert_allclose(np.exp(1j * moved), 1, atol=1e-9)
    assert_allclose(peak_rate(turned, seconds), curve.max())


def test_single_heading_and_silence() -> None:
    curves = np.zeros((2, 36))
    curves[0, 9] = 4.0
    assert_allclose(mean_vector_length(curves, np.ones(36)), [1, np.nan])
    assert_allclose(preferred_direction(curves, np.ones(36)), [np.pi / 2, np.nan])


def test_uneven_sampling_of_headings_gives_no_tuning() -> None:
    seconds = 1 + 10 * (ANGLES < 1.0)
    assert_allclose(mean_vector_length(np.full((1, 36), 2.0), seconds), 0, atol=1e-12)
    assert_allclose(rayleigh_p(np.full((1, 36), 2.0), seconds), 1)


def test_rayleigh_z_is_spikes_times_squared_length() -> None:
    curve, seconds = (1 + 0.3 * np.cos(ANGLES))[None], np.full(36, 2.0)
    assert_allclose(rayleigh_z(curve, seconds), 72 * 0.15**2)
    # exp(-z) to first order in 1 / N.
    assert_allclose(rayleigh_p(curve, seconds), np.exp(-72 * 0.15**2), rtol=0.03)


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_p_values_of_untuned_cells_are_uniform(share: float) -> None:
    draw = stream(0, "spikes")
    headings = draw.uniform(0, 2 * np.pi, (4000, 60))
    flat = circle_bin(headings, 36) + 36 * np.arange(4000)[:, None]
    counts = np.bincount(flat.ravel(), minlength=4000 * 36).reshape(4000, 36).astype(float)
    below = (rayleigh_p(counts, np.ones(36)) < share).mean()
    # Four standard errors of a share of 4000.
    assert abs(below - share) < 4 * np.sqrt(share * (1 - share) / 4000)
