"""Rate maps and tuning curves: occupancy, smoothing, bad input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from evaluation.cells.rate_map import (
    arena_edges,
    bin_activity,
    circle_bin,
    heading_index,
    place_index,
    rate_maps,
    sample_seconds,
    smooth_plane,
    smooth_rates,
    tuning_curves,
    weigh_bins,
)
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tests.evaluation.cells.box_walk import EDGES, mixed_cells, mixed_sums, random_walk

WALK = random_walk()


def test_all_time_and_activity_lies_in_some_bin() -> None:
    sums = mixed_sums(WALK)
    total = (mixed_cells(WALK) * sample_seconds(WALK.time)[:, None]).sum(axis=0)
    assert_allclose(sums.seconds.sum(), 600, rtol=1e-9)
    assert_allclose(sums.heading_seconds.sum(), 600, rtol=1e-9)
    assert_allclose(sums.place.sum(axis=(1, 2)), total, rtol=1e-9)
    assert_allclose(sums.heading.sum(axis=1), total, rtol=1e-9)


def test_maps_show_the_tuning_of_the_cells() -> None:
    rates = rate_maps(mixed_sums(WALK), smoothing=0)
    row, column = np.unravel_index(np.nanargmax(rates[0]), (20, 20))
    assert abs(EDGES[column] + 0.025 - 0.2) < 0.06
    assert abs(EDGES[row] + 0.025 - 0.3) < 0.06
    assert np.nanargmax(tuning_curves(mixed_sums(WALK))[6]) == circle_bin(np.array(0.5), 36)


@pytest.mark.parametrize("smoothing", [0.0, 1.5, 3.0])
def test_a_cell_that_is_always_active_has_a_flat_map(smoothing: float) -> None:
    sums = mixed_sums(WALK)
    rates = rate_maps(sums, smoothing)[9]
    assert_allclose(rates[np.isfinite(rates)], 1.0, rtol=1e-12)
    curve = tuning_curves(sums)[9]
    assert_allclose(curve[np.isfinite(curve)], 1.0, rtol=1e-12)


def test_bins_with_too_little_time_have_no_rate() -> None:
    sums = mixed_sums(WALK)
    rates = rate_maps(sums, least_seconds=1.0)
    assert (np.isnan(rates) == (sums.seconds < 1.0)).all()
    assert 0 < np.isnan(rates[0]).sum() < 400


@settings(derandomize=True, max_examples=30, deadline=None)
@given(st.integers(3, 25), st.integers(3, 25), st.floats(0.3, 5.0))
def test_smoothing_keeps_the_sum(height: int, width: int, sigma: float) -> None:
    values = stream(height * 100 + width, "smoothing").random((2, height, width))
    assert_allclose(smooth_plane(values, sigma).sum(axis=(1, 2)), values.sum(axis=(1, 2)), rtol=1e-12)


def test_finished_maps_are_smoothed_as_sums_are() -> None:
    sums = mixed_sums(WALK)
    rates = smooth_rates(rate_maps(sums, 0.0, 1e-3), sums.seconds, 1.5)
    assert_allclose(rates, rate_maps(sums, 1.5, 1e-3), rtol=1e-9)


def test_unknown_poses_do_not_count() -> None:
    truth = WALK.truth.copy()
    truth[1000:3000, 0] = np.nan
    known = np.isfinite(truth).all(axis=1)
    sums = bin_activity(WALK.time, truth, mixed_cells(WALK), EDGES, EDGES)
    assert_allclose(sums.seconds.sum(), known.sum() * 0.05, rtol=1e-9)
    assert np.isfinite(sums.place).all()


def test_last_edge_belongs_to_the_last_bin() -> None:
    truth = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [1.01, 0.5, 0.0]])
    sums = bin_activity(np.arange(3.0), truth, np.ones((3, 1)), EDGES, EDGES)
    assert sums.seconds[0, 0] == sums.seconds[19, 19] == 1.0
    assert sums.seconds.sum() == 2.0


def test_headings_lie_round_the_centre_of_their_bin() -> None:
    angle = np.array([0.0, 0.08, -0.08, 2 * np.pi - 0.08, np.pi])
    assert circle_bin(angle, 36).tolist() == [0, 0, 0, 0, 18]


def test_indices_are_those_of_the_sums() -> None:
    truth = WALK.truth.copy()
    truth[:100, 0], truth[100:200, 2] = np.nan, np.nan
    sums, place, heading = mixed_sums(WALK), place_index(truth, EDGES, EDGES), heading_index(truth, 36)
    assert (place[:100] == -1).all()
    assert (heading[100:200] == -1).all()
    whole = place_index(WALK.truth, EDGES, EDGES), heading_index(WALK.truth, 36)
    assert_allclose(np.bincount(whole[0], minlength=400) * 0.05, sums.seconds.ravel(), atol=1e-9)
    assert_allclose(np.bincount(whole[1], minlength=36) * 0.05, sums.heading_seconds, atol=1e-9)


def _bin(time: np.ndarray, truth: np.ndarray, activity: np.ndarray) -> None:
    bin_activity(time, truth, activity, EDGES, EDGES)


def test_bad_paths_give_one_clear_error() -> None:
    time, truth, activity = np.arange(5.0), np.full((5, 3), 0.5), np.ones((5, 2))
    with pytest.raises(InputError, match="no known pose"):
        _bin(time, np.full((5, 3), np.nan), activity)
    with pytest.raises(InputError, match="no known pose"):
        arena_edges(np.full((5, 3), np.nan))
    with pytest.raises(InputError, match="no time is spent"):
        _bin(time, truth + 7, activity)
    with pytest.raises(InputError, match="equal lengths"):
        _bin(time, truth[:4], activity)
    with pytest.raises(InputError, match="rising times"):
        _bin(time[::-1], truth, activity)
    with pytest.raises(InputError, match="without width"):
        arena_edges(truth)


def test_bad_sums_give_one_clear_error() -> None:
    sums = mixed_sums(WALK)
    with pytest.raises(InputError, match="visited arena"):
        rate_maps(sums._replace(seconds=np.zeros((20, 20))))
    with pytest.raises(InputError, match="visited arena"):
        tuning_curves(sums._replace(heading_seconds=np.zeros(36)))
    with pytest.raises(InputError, match=r"sums\.place"):
        rate_maps(sums._replace(seconds=np.ones((20, 19))))
    with pytest.raises(InputError, match=r"sums\.heading"):
        tuning_curves(sums._replace(heading_seconds=np.ones(35)))
    with pytest.raises(InputError, match="no time in any bin"):
        weigh_bins(np.ones((2, 5)), np.zeros(5))
    with pytest.raises(InputError, match="bins of the rates"):
        weigh_bins(np.ones((2, 5)), np.ones(6))
