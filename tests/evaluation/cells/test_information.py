"""Laws of information, sparsity, selectivity, coherence and the conjunctive score."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from evaluation.cells.information import (
    conjunctive_information,
    information,
    information_above_mean,
    information_rate,
    mean_rate,
    selectivity,
    sparsity,
)
from evaluation.cells.rate_map import box_samples, coherence, correlate, neighbour_means, rate_maps, sum_into
from tactile.base.random_streams import stream
from tests.evaluation.cells.box_walk import direction_cells, mixed_sums, place_cells, random_walk

SEEDS = st.integers(0, 10**6)


def _scene(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rates [4, 6, 7] with bins without a rate, and seconds [6, 7]."""
    draw = stream(seed, "scene")
    rates = draw.exponential(1.0, (4, 6, 7))
    rates[:, draw.random((6, 7)) < 0.2] = np.nan
    return rates, draw.exponential(2.0, (6, 7)) + 0.01


@settings(derandomize=True, max_examples=50, deadline=None)
@given(SEEDS, st.floats(1e-6, 1e6))
def test_scores_do_not_depend_on_the_scale_of_rates_and_times(seed: int, scale: float) -> None:
    rates, seconds = _scene(seed)
    for score in (information, information_above_mean, sparsity, selectivity, coherence):
        assert_allclose(score(rates * scale, seconds * 3), score(rates, seconds), rtol=1e-9, atol=1e-12)
    assert_allclose(information_rate(rates * scale, seconds), information_rate(rates, seconds) * scale)


@settings(derandomize=True, max_examples=50, deadline=None)
@given(SEEDS)
def test_bounds(seed: int) -> None:
    rates, seconds = _scene(seed)
    known = np.isfinite(rates[0])
    share = seconds[known] / seconds[known].sum()
    assert (information(rates, seconds) >= -1e-12).all()
    assert (information(rates, seconds) <= np.log2(1 / share.min()) + 1e-12).all()
    assert (information_above_mean(rates, seconds) >= information(rates, seconds)).all()
    assert ((sparsity(rates, seconds) > 0) & (sparsity(rates, seconds) <= 1 + 1e-12)).all()
    assert (selectivity(rates, seconds) >= 1 - 1e-12).all()


def test_flat_map_tells_nothing() -> None:
    rates, seconds = np.full((1, 6, 7), 3.0), _scene(0)[1]
    assert_allclose(information(rates, seconds), 0, atol=1e-15)
    assert_allclose(sparsity(rates, seconds), 1)
    assert_allclose(selectivity(rates, seconds), 1)
    assert_allclose(mean_rate(rates, seconds), 3)
    assert np.isnan(coherence(rates, seconds)).all()


def test_cell_in_one_of_eight_bins_gives_three_bits() -> None:
    rates = np.zeros((1, 8))
    rates[0, 3] = 5.0
    assert_allclose(information(rates, np.ones(8)), 3)
    assert_allclose(information_rate(rates, np.ones(8)), 3 * 5 / 8)
    assert_allclose(sparsity(rates, np.ones(8)), 1 / 8)
    assert_allclose(selectivity(rates, np.ones(8)), 8)


def test_silent_cell_has_no_scores() -> None:
    rates, seconds = np.zeros((1, 6, 7)), np.ones((6, 7))
    for score in (information, information_above_mean, information_rate, sparsity, selectivity, coherence):
        assert np.isnan(score(rates, seconds)).all()


def test_place_cells_are_more_coherent_than_noise() -> None:
    sums = mixed_sums(random_walk())
    rates = rate_maps(sums, smoothing=0)
    noise = stream(1, "noise").permuted(rates.reshape(10, -1), axis=1).reshape(rates.shape)
    assert (coherence(rates, sums.seconds)[:6] > 1.2).all()
    assert (abs(coherence(noise, sums.seconds)[:6]) < 0.2).all()


def test_neighbours_outside_do_not_count() -> None:
    rates = np.arange(9.0).reshape(1, 3, 3)
    assert_allclose(neighbour_means(rates)[0, 0, 0], (1 + 3 + 4) / 3)
    rates[0, 1, 1] = np.nan
    assert_allclose(neighbour_means(rates)[0, 0, 0], (1 + 3) / 2)


def test_correlation_is_that_of_numpy() -> None:
    a, b = _scene(1)[0], _scene(2)[0]
    for i in range(4):
        known = np.isfinite(a[i]) & np.isfinite(b[i])
        assert_allclose(correlate(a, b)[i], np.corrcoef(a[i][known], b[i][known])[0, 1])


def test_conjunctive_information_of_products() -> None:
    place, turn = stream(0, "place").random((5, 6)), stream(0, "turn").random(8)
    seconds = np.multiply.outer(np.ones(8), 0.5 + stream(0, "time").random((5, 6)))
    joint = np.stack([np.multiply.outer(turn, place), np.multiply.outer(np.ones(8), place)])
    alone = information(place[None], seconds[0])[0], information(turn[None], np.ones(8))[0]
    assert_allclose(conjunctive_information(joint, seconds), [min(alone), 0], atol=1e-12)


@settings(derandomize=True, max_examples=30, deadline=None)
@given(SEEDS)
def test_joint_map_tells_more_than_either_part(seed: int) -> None:
    draw = stream(seed, "joint")
    seconds = draw.exponential(1.0, (4, 3, 5)) * (draw.random((4, 3, 5)) < 0.8)
    rates = np.where(seconds > 0, draw.exponential(1.0, (3, 4, 3, 5)), np.nan)
    assert (conjunctive_information(rates, seconds) >= -1e-12).all()
    assert (conjunctive_information(rates, seconds) <= information(rates, seconds) + 1e-12).all()


def test_product_cells_are_conjunctive_and_others_are_not() -> None:
    walk = random_walk()
    place = place_cells(walk.truth[:, :2], np.array([[0.4, 0.6]]), width=0.2)
    turn = direction_cells(walk.truth[:, 2], np.array([1.0]))
    edges = np.linspace(0, 1, 11)
    samples = box_samples(*walk, np.concatenate([place * turn, place, turn], axis=1), edges, edges, 8)
    at = samples.heading * 100 + samples.place
    seconds, sums = sum_into(at, samples.seconds, samples.activity, (8, 10, 10))
    rates = sums / np.where(seconds > 0, seconds, np.nan)
    both, place_only, turn_only = conjunctive_information(rates, seconds)
    assert both > 0.5
    assert place_only < 0.1
    assert turn_only < 0.15
