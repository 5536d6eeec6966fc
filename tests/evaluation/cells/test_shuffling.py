"""Shuffled controls: the sums, the percentile, and the calibration on cells that are themselves shuffled."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from evaluation.cells.grid_score import HEXAGONAL, SQUARE, autocorrelogram, lattice_scores
from evaluation.cells.shuffling import PathBins, Score, ShuffledScores, calibrate, shuffled_scores
from tactile.base.errors import InputError


def smooth(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    sums = gaussian_filter(np.nan_to_num(rates) * seconds, (0, 1.5, 1.5))
    return sums / np.maximum(gaussian_filter(seconds, 1.5), 1e-9)


def information(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """Bit per unit of activity, over bins of any shape (Skaggs et al. 1993)."""
    share = (seconds / seconds.sum()).ravel()
    rates = np.nan_to_num(rates).reshape(len(rates), -1)
    relative = rates / (rates @ share)[:, None]
    return (relative * np.log2(np.where(relative > 0, relative, 1))) @ share


def vector_length(curves: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    curves = np.nan_to_num(curves)
    wave = np.exp(2j * np.pi * np.arange(curves.shape[1]) / curves.shape[1])
    return np.abs(curves @ wave) / curves.sum(axis=1)


PLACE_SCORES: dict[str, Score] = {
    "hexagonal": lambda rates, seconds: lattice_scores(autocorrelogram(smooth(rates, seconds)), HEXAGONAL),
    "square": lambda rates, seconds: lattice_scores(autocorrelogram(smooth(rates, seconds)), SQUARE),
    "information": information,
}


def random_walk(samples: int, interval: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions [T, 2] in a box of 1 m, reflected at the walls, 0.2 m/s, and headings [T], rad."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(0, 0.8 * np.sqrt(interval), samples)) * 2
    way = np.cumsum(0.2 * interval * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0) + 0.5
    return 1 - np.abs(way % 2 - 1), heading


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


def bin_box(position: np.ndarray, bins: int, interval: float) -> PathBins:
    column, row = np.clip((position * bins).astype(int), 0, bins - 1).T
    return PathBins(row * bins + column, (bins, bins), np.full(len(position), interval))


def bin_circle(heading: np.ndarray, bins: int, interval: float) -> PathBins:
    flat = np.round(heading * bins / (2 * np.pi)).astype(int) % bins
    return PathBins(flat, (bins,), np.full(len(heading), interval))


@pytest.fixture(scope="module")
def walk() -> tuple[np.ndarray, np.ndarray]:
    return random_walk(6000, 0.1, seed=0)


def test_the_recorded_score_is_that_of_the_mean_activity_in_each_bin(walk):
    activity = torus_cells(walk[0], 3, seed=1)
    bins = bin_box(walk[0], 8, 0.1)
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
        if here.any():
            np.testing.assert_allclose(rates.reshape(3, -1)[:, bin_], activity[here].mean(axis=0), rtol=1e-9)
        else:
            assert np.isnan(rates.reshape(3, -1)[:, bin_]).all()


def test_a_shuffle_is_a_circular_shift_of_at_least_20_s_of_each_cell(walk):
    samples = 600
    activity = np.tile(np.arange(samples, dtype=float)[:, None], (1, 50))
    bins = PathBins(np.arange(samples), (samples,), np.full(samples, 0.1))
    result = shuffled_scores(activity, bins, lambda rates, seconds: rates[:, 0], shuffles=40)
    np.testing.assert_array_equal(result.score, 0)
    shift = samples - result.shuffled
    assert shift.min() == pytest.approx(200, abs=8)
    assert shift.max() == pytest.approx(400, abs=8)
    assert shift.min() >= 200
    assert shift.max() <= 400
    assert len(np.unique(shift[0])) > 1
    again = shuffled_scores(activity, bins, lambda rates, seconds: rates[:, 0], shuffles=40)
    other = shuffled_scores(activity, bins, lambda rates, seconds: rates[:, 0], shuffles=40, seed=1)
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


def test_one_in_twenty_independent_scores_exceeds_the_percentile_of_its_shuffles():
    rng = np.random.default_rng(1)
    result = ShuffledScores(rng.normal(size=40000), rng.normal(size=(100, 40000)))
    assert result.above.mean() == pytest.approx(0.05, abs=0.003)


def test_cells_of_a_place_exceed_their_shuffles_and_cells_of_another_path_do_not(walk):
    other, _ = random_walk(6000, 0.1, seed=9)
    bins = bin_box(walk[0], 16, 0.1)
    place = shuffled_scores(torus_cells(walk[0], 40, seed=2)[:, ::2], bins, information, shuffles=39)
    elsewhere = shuffled_scores(torus_cells(other, 40, seed=2)[:, ::2], bins, information, shuffles=39)
    assert place.above.all()
    assert (place.score > 2 * place.mean).all()
    assert elsewhere.above.mean() < 0.3


@pytest.mark.parametrize("name", list(PLACE_SCORES))
def test_shuffled_cells_exceed_their_shuffles_in_5_percent_along_a_walk(walk, name):
    activity = torus_cells(walk[0], 60, seed=3)
    result = calibrate(activity, bin_box(walk[0], 12, 0.1), PLACE_SCORES[name], shuffles=19, seed=5)
    assert result.cells > 50
    assert result.low <= result.share <= result.high
    assert result.low == pytest.approx(0.0, abs=0.02)
    assert result.high == pytest.approx(0.11, abs=0.02)


def test_shuffled_heading_cells_exceed_their_shuffles_in_5_percent(walk):
    activity = heading_cells(walk[1], 100, seed=4)
    result = calibrate(activity, bin_circle(walk[1], 36, 0.1), vector_length, shuffles=39, seed=6)
    assert result.cells == 100
    assert result.low <= result.share <= result.high
    assert 0 < result.shuffled_mean < 1


def heading_cells(heading: np.ndarray, cells: int, seed: int) -> np.ndarray:
    preferred = np.random.default_rng(seed).uniform(0, 2 * np.pi, cells)
    return np.exp(2 * np.cos(heading[:, None] - preferred))


@pytest.mark.parametrize(
    ("samples", "change", "message"),
    [
        (600, lambda bins: bins._replace(flat=np.full(600, np.nan)), "NaN"),
        (600, lambda bins: bins._replace(flat=np.full(600, 64)), "no such bin"),
        (600, lambda bins: bins._replace(flat=np.full(600, -1)), "no time in any bin"),
        (600, lambda bins: bins._replace(seconds=np.ones(5)), "samples"),
        (150, lambda bins: bins, "more than 40 s"),
        (400, lambda bins: bins, "more than 40 s"),
    ],
)
def test_bad_input_is_one_error(walk, samples, change, message):
    bins = change(bin_box(walk[0][:samples], 8, 0.1))
    with pytest.raises(InputError, match=message):
        shuffled_scores(np.ones((samples, 2)), bins, information)


@pytest.fixture
def rat(data: Callable[[str], Path]) -> np.ndarray:
    with np.load(data("real_touch/rat_trajectories_ratinabox/sargolini.npz")) as file:
        return file["pos"]


@pytest.mark.soak
@pytest.mark.parametrize("name", list(PLACE_SCORES))
@pytest.mark.parametrize("path", ["walk", "rat"])
def test_500_shuffled_cells_exceed_their_100_shuffles_in_5_percent(request, name, path):
    position = request.getfixturevalue("rat") if path == "rat" else random_walk(30000, 0.02, seed=7)[0]
    activity = torus_cells(position, 500, seed=8)
    result = calibrate(activity, bin_box(position, 20, 0.02), PLACE_SCORES[name], seed=9)
    print(f"{path} {name}: {result}")
    assert result.cells == 500
    assert result.low <= result.share <= result.high
