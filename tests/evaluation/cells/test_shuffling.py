"""Shuffled controls: the sums, the percentile, and the calibration on cells that are themselves shuffled."""

from __future__ import annotations

import numpy as np
import pytest

from evaluation.cells.grid_score import SQUARE, autocorrelogram, lattice_scores
from evaluation.cells.information import information
from evaluation.cells.rate_map import smooth_rates
from evaluation.cells.shuffling import PathBins, ShuffledScores, calibrate, shuffled_scores
from tactile.base.errors import InputError
from tests.evaluation.cells.box_walk import random_walk


def lattice(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    return lattice_scores(autocorrelogram(np.nan_to_num(smooth_rates(rates, seconds, 1.5))), SQUARE)


def torus_cells(position: np.ndarray, cells: int, seed: int) -> np.ndarray:
    """Activity [T, C] of bumps on a torus of 0.41 m; the packet of every second cell drifts."""
    rng = np.random.default_rng(seed)
    drift = np.cumsum(rng.normal(0, 0.002, position.shape), axis=0)
    phase, width = rng.uniform(0, 0.41, (cells, 2)), rng.uniform(0.05, 0.1, cells)
    activity = np.empty((len(position), cells))
    for cell in range(cells):
        angle = 2 * np.pi / 0.41 * (position + drift * (cell % 2) - phase[cell])
        kappa = (0.41 / (2 * np.pi * width[cell])) ** 2
        activity[:, cell] = np.exp(kappa * (np.cos(angle).sum(axis=1) - 2))
    return activity


def bin_box(position: np.ndarray, bins: int) -> PathBins:
    column, row = np.clip((position * bins).astype(int), 0, bins - 1).T
    return PathBins(row * bins + column, (bins, bins), np.full(len(position), 0.1))


@pytest.fixture(scope="module")
def walk() -> np.ndarray:
    return random_walk(6000, 0.1).truth


def test_the_recorded_score_is_that_of_the_mean_activity_in_each_bin(walk):
    activity = torus_cells(walk[:, :2], 3, seed=1)
    bins = bin_box(walk[:, :2], 8)
    bins.flat[::7] = -1
    seen = []

    def collect(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
        seen.append((rates, seconds))
        return rates[:, 0, 0]

    shuffled_scores(activity, bins, collect, shuffles=1)
    rates, seconds = seen[0]
    for bin_ in range(64):
        here = bins.flat == bin_
        assert seconds.ravel()[bin_] == pytest.approx(0.1 * here.sum())
        expected = activity[here].mean(axis=0) if here.any() else np.full(3, np.nan)
        np.testing.assert_allclose(rates.reshape(3, -1)[:, bin_], expected, rtol=1e-9)


def test_a_shuffle_is_a_circular_shift_of_at_least_20_s_of_each_cell():
    samples = 600
    activity = np.tile(np.arange(samples, dtype=float)[:, None], (1, 50))
    bins = PathBins(np.arange(samples), (samples,), np.full(samples, 0.1))
    result, again, other = (
        shuffled_scores(activity, bins, lambda rates, seconds: rates[:, 0], shuffles=40, seed=seed)
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(result.score, 0)
    shift = samples - result.shuffled
    assert 200 <= shift.min() <= 208
    assert 392 <= shift.max() <= 400
    assert len(np.unique(shift[0])) > 1
    np.testing.assert_array_equal(again.shuffled, result.shuffled)
    assert (other.shuffled != result.shuffled).any()


def test_the_percentile_is_numpys_weibull_rule_without_missing_scores():
    scores = np.random.default_rng(0).normal(size=(100, 4))
    scores[::3, 1] = np.nan
    scores[18:, 2] = np.nan
    scores[:, 3] = 2.0
    result = ShuffledScores(np.array([9.0, np.nan, 9.0, 2.0]), scores)
    for cell in (0, 1, 3):
        known = scores[np.isfinite(scores[:, cell]), cell]
        assert result.percentile[cell] == pytest.approx(np.quantile(known, 0.95, method="weibull"))
        assert result.mean[cell] == pytest.approx(known.mean())
    assert np.isnan(result.percentile[2])
    np.testing.assert_array_equal(result.above, [True, False, False, False])


@pytest.mark.parametrize("score", [lattice, information])
def test_shuffled_cells_exceed_their_shuffles_in_5_percent_along_a_walk(walk, score):
    activity = torus_cells(walk[:, :2], 60, seed=3)
    result = calibrate(activity, bin_box(walk[:, :2], 12), score, shuffles=19, seed=5)
    assert result.cells > 50
    assert result.low <= result.share <= result.high
    assert result.low == pytest.approx(0.0, abs=0.02)
    assert result.high == pytest.approx(0.11, abs=0.02)


def test_a_score_of_few_values_ties_with_its_percentile(walk):
    bins = bin_box(walk[:, :2], 8)
    result = calibrate(np.ones((len(walk), 4)), bins, lambda rates, seconds: np.full(4, 2.0), shuffles=19)
    assert (result.cells, result.share, result.tied, result.shuffled_mean) == (4, 0.0, 1.0, 2.0)


@pytest.mark.parametrize(
    ("samples", "change", "message"),
    [
        (600, lambda bins: bins._replace(flat=np.full(600, np.nan)), "NaN"),
        (600, lambda bins: bins._replace(flat=np.full(600, 64)), "no such bin"),
        (600, lambda bins: bins._replace(flat=np.full(600, -1)), "no time in any bin"),
        (600, lambda bins: bins._replace(seconds=np.ones(5)), "samples"),
        (400, lambda bins: bins, "more than 40 s"),
    ],
)
def test_unfit_paths_are_refused(walk, samples, change, message):
    bins = change(bin_box(walk[:samples, :2], 8))
    with pytest.raises(InputError, match=message):
        shuffled_scores(np.ones((samples, 2)), bins, information)
