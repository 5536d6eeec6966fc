"""Decoded places, drift of the packet and phase of the sheet, and shuffled controls, calibrated."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.special import gammaln, xlogy
from scipy.stats import nbinom

from evaluation.cells import sheet_phase
from evaluation.cells.decoding import decode_positions, log_posterior, packet_drift, truth_in_sheet
from evaluation.cells.grid_score import SQUARE, autocorrelogram, lattice_scores
from evaluation.cells.information import information
from evaluation.cells.rate_map import smooth_rates
from evaluation.cells.recording import CellRecording
from evaluation.cells.shuffling import PathBins, ShuffledScores, calibrate, shuffled_scores
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import compose
from tests.evaluation.cells.box_walk import SHAPE, Walk, place_cells, random_walk, sheet_recording

WALK = random_walk()
WIDE = Walk(WALK.time, WALK.truth * np.array([1.6, 1.6, 1.0]))
CELLS = stream(0, "cells").choice(np.prod(SHAPE), 60, replace=False)
NONE = np.zeros(0, int)


def recording() -> CellRecording:
    centres = stream(0, "centres").random((50, 2))
    activity = place_cells(WALK.truth[:, :2], centres).astype(np.float32)
    return sheet_recording(WALK, NONE)._replace(cell=np.arange(50), activity=activity)


def test_place_cells_tell_the_place_to_within_a_bin_where_it_is_known_at_any_scale_and_seed() -> None:
    found = decode_positions(recording())
    assert len(found.time) == 1200
    assert_allclose(found.time[:2], [0.225, 0.725])
    assert found.median == np.median(found.error) < 0.05
    assert_allclose(found.error, np.linalg.norm(found.decoded - found.truth, axis=1))
    # Two independent points of a unit square are 0.51 m apart in the median.
    assert 0.35 < np.median(found.control) < 0.6
    assert found.control.min() > 3 * found.median
    one = recording()
    one.truth[3000:5000] = np.nan
    found, other = decode_positions(one), decode_positions(one, shifts=5, seed=1)
    scaled = decode_positions(one._replace(activity=one.activity * np.float32(1 / 1024)))
    assert len(found.time) == 1000
    assert not ((found.time > 150) & (found.time < 249)).any()
    assert found.median < 0.05
    assert (found.decoded == scaled.decoded).all()
    assert (found.control == scaled.control).all()
    assert (found.decoded == other.decoded).all()
    assert (other.control != found.control[:5]).any()


def test_the_posterior_is_that_of_poisson_cells() -> None:
    rates = stream(0, "rates").random((3, 2, 4)) + 0.1
    rates[:, 1, 3] = np.nan
    counts, seconds = np.array([[2, 0, 1], [0, 4, 0]]), np.array([0.5, 2.0])
    prior = np.log(np.arange(1.0, 9.0).reshape(2, 4) / 36)
    found = log_posterior(counts, seconds, rates, prior)
    mean = rates[None] * seconds[:, None, None, None]
    each = xlogy(counts[:, :, None, None], mean) - mean - gammaln(counts + 1.0)[:, :, None, None]
    known = np.isfinite(rates[0])
    assert np.isneginf(found[:, ~known]).all()
    difference = (found - each.sum(axis=1) - prior)[:, known]
    assert_allclose(difference, difference[:, :1] * np.ones(7), atol=1e-12)


def test_rates_that_were_estimated_in_little_time_make_the_posterior_less_sure() -> None:
    """Negative binomial counts; with much time those of Poisson cells."""
    rates = stream(1, "rates").random((3, 2, 4)) * 9 + 0.1
    counts, seconds = stream(1, "counts").poisson(1.5, (6, 3)), np.array([0.5, 0.5, 2.0, 0.5, 2.0, 1.0])
    exposure, prior = np.full((2, 4), 3.0), np.zeros((2, 4))
    shape = rates * 3 + 0.5
    spent = 3 + 0.5 / rates.mean(axis=(1, 2), keepdims=True)
    theirs = [
        nbinom.logpmf(n[:, None, None], shape, spent / (spent + t)).sum(axis=0)
        for n, t in zip(counts, seconds, strict=True)
    ]
    difference = (log_posterior(counts, seconds, rates, prior, exposure) - theirs).reshape(6, -1)
    assert_allclose(difference, difference[:, :1] * np.ones(8), atol=1e-9)
    known = log_posterior(counts, seconds, rates, prior)
    long = log_posterior(counts, seconds, rates, prior, exposure * 1e7)
    assert_allclose(long - long[:, :1, :1], known - known[:, :1, :1], atol=1e-4)

    def entropy(logs: np.ndarray) -> np.ndarray:
        share = np.exp(logs - logs.max(axis=(1, 2), keepdims=True)).reshape(len(logs), -1)
        share /= share.sum(axis=1, keepdims=True)
        return -xlogy(share, share).sum(axis=1)

    assert entropy(log_posterior(counts, seconds, rates, prior, exposure / 10)).mean() > entropy(known).mean()


def test_drift_is_followed_beyond_the_torus_and_unfit_recordings_are_refused() -> None:
    assert_allclose(packet_drift(sheet_recording(WIDE, NONE)), 0, atol=1e-9)
    ramp = np.linspace(0, 1, len(WIDE.time))[:, None] * np.array([3.0, -2.5, 20.0])
    assert_allclose(packet_drift(sheet_recording(WIDE, NONE, ramp)), ramp, atol=1e-9)
    one = sheet_recording(WIDE, NONE)
    one.truth[:10] = one.truth[200:400, 1] = np.nan
    known = np.isfinite(one.truth).all(axis=1, keepdims=True)
    assert_allclose(packet_drift(one), np.where(known, 0, [np.nan] * 3), atol=1e-9)
    one = sheet_recording(WIDE, NONE)
    with pytest.raises(InputError, match="four blocks"):
        decode_positions(recording(), block=200.0)
    with pytest.raises(InputError, match="no known pose"):
        packet_drift(one._replace(truth=np.full_like(one.truth, np.nan)))
    with pytest.raises(InputError, match="equal lengths"):
        packet_drift(one._replace(packet=one.packet[:-1]))
    with pytest.raises(InputError, match="equal lengths"):
        sheet_phase.folded_maps(one._replace(activity=one.activity[:-1]))


@given(st.floats(-4, 4), st.floats(-4, 4), st.floats(-7, 7))
def test_the_frame_of_the_truth_does_not_matter(x: float, y: float, turn: float) -> None:
    one = sheet_recording(Walk(WIDE.time[:500], WIDE.truth[:500]), NONE)
    elsewhere = one._replace(truth=compose(np.array([x, y, turn]), one.truth))
    assert_allclose(truth_in_sheet(elsewhere)[:, :2], truth_in_sheet(one)[:, :2], atol=1e-9)
    assert_allclose(packet_drift(elsewhere), 0, atol=1e-8)


def test_cells_of_a_perfect_sheet_fire_at_their_place_and_shuffled_ones_do_not() -> None:
    one = sheet_recording(WIDE, CELLS)
    side = one.torus_sides[:2]
    assert side == pytest.approx((1.05, 1.05))
    assert_allclose(one.packet_pose[0], truth_in_sheet(one)[0] % [*side, 2 * np.pi])
    phase = sheet_phase.map_phases(*sheet_phase.folded_maps(one))
    own = sheet_phase.sheet_phases(CELLS, SHAPE)
    correlation, offset, residual = sheet_phase.compare_phases(own, phase, side)
    assert correlation.min() > 0.98
    assert abs(offset).max() < 0.01
    assert residual.max() < 0.03
    other = stream(2, "shuffle").permutation(own)
    correlation, _, residual = sheet_phase.compare_phases(other, phase, side)
    assert abs(correlation).max() < 0.3
    assert residual.min() > 0.2
    # Cells are in the order heading, y, x; a silent one has no phase.
    cell = np.array([5 * 21 * 21 + 7 * 21 + 3])
    assert_allclose(sheet_phase.sheet_phases(cell, SHAPE), 2 * np.pi * np.array([[3 / 21, 7 / 21]]))
    rates = np.zeros((2, 5, 5))
    rates[1, 2, 1] = 1.0
    phase = sheet_phase.map_phases(rates, np.ones((5, 5)))
    assert_allclose(phase, 2 * np.pi * np.array([[np.nan, np.nan], [0.2, 0.4]]))


@given(st.integers(0, 1000), st.floats(-7, 7))
def test_circular_correlation_is_the_sum_over_pairs(seed: int, offset: float) -> None:
    a, b = stream(seed, "angles").uniform(0, 2 * np.pi, (2, 12))
    pair_a, pair_b = (np.sin(each[:, None] - each) for each in (a, b))
    pairs = (pair_a * pair_b).sum() / np.sqrt((pair_a**2).sum() * (pair_b**2).sum())
    assert_allclose(sheet_phase.circular_correlation(a, b), pairs, atol=1e-9)
    assert_allclose(sheet_phase.circular_correlation(a, a + offset), 1, atol=1e-9)
    assert_allclose(sheet_phase.circular_correlation(a, offset - a), -1, atol=1e-9)


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


def test_a_shuffle_is_a_circular_shift_of_at_least_20_s_and_equal_scores_tie(walk):
    samples = 600
    activity = np.tile(np.arange(samples, dtype=float)[:, None], (1, 50))
    bins = PathBins(np.arange(samples), (samples,), np.full(samples, 0.1))
    result, again, other = (
        shuffled_scores(activity, bins, lambda rates, seconds: rates[:, 0], shuffles=40, seed=seed)
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(result.score, 0)
    shift = samples - result.shuffled
    assert 200 <= shift.min() <= 208 < 392 <= shift.max() <= 400
    assert len(np.unique(shift[0])) > 1
    np.testing.assert_array_equal(again.shuffled, result.shuffled)
    assert (other.shuffled != result.shuffled).any()
    bins = bin_box(walk[:, :2], 8)
    result = calibrate(np.ones((len(walk), 4)), bins, lambda rates, seconds: np.full(4, 2.0), shuffles=19)
    assert (result.cells, result.share, result.tied, result.shuffled_mean) == (4, 0.0, 1.0, 2.0)


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
    assert (result.low, result.high) == pytest.approx((0.0, 0.11), abs=0.02)


@pytest.mark.parametrize(("samples", "change", "message"), [
    (600, {"flat": np.full(600, np.nan)}, "NaN"),
    (600, {"flat": np.full(600, 64)}, "no such bin"),
    (600, {"flat": np.full(600, -1)}, "no time in any bin"),
    (600, {"seconds": np.ones(5)}, "samples"),
    (400, {}, "more than 40 s"),
])  # fmt: skip
def test_unfit_paths_are_refused(walk, samples, change, message):
    bins = bin_box(walk[:samples, :2], 8)._replace(**change)
    with pytest.raises(InputError, match=message):
        shuffled_scores(np.ones((samples, 2)), bins, information)
