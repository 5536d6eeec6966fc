"""The scores against opexebo and pynapple on the same cells, to 1e-6, in matching bins and smoothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from evaluation.cells.fields import find_fields, score_borders
from evaluation.cells.head_direction import mean_vector_length, peak_rate, preferred_direction
from evaluation.cells.information import (
    information,
    information_above_mean,
    information_rate,
    selectivity,
    sparsity,
)
from evaluation.cells.rate_map import (
    bin_activity,
    correlate,
    neighbour_means,
    rate_maps,
    smooth_plane,
    smooth_rates,
    tuning_curves,
)
from evaluation.cells.recording import BinnedSums
from evaluation.papers.cells.agreement import border_score, mutual_information, quiet
from tactile.base.random_streams import stream
from tests.evaluation.cells.box_walk import EDGES, mixed_cells, random_walk

WALK = random_walk()
RATE = 8.0
"""Spikes/s of a cell with activity 1."""


def _import(name: str) -> ModuleType:
    with quiet():
        return pytest.importorskip(name)


def _quietly(function: Callable[..., Any], *args: Any, **keys: Any) -> Any:
    with quiet():
        return function(*args, **keys)


@pytest.fixture(scope="module")
def opexebo() -> ModuleType:
    return _import("opexebo")


@pytest.fixture(scope="module")
def spikes() -> np.ndarray:
    """[T, 10] number of spikes in each step of 0.05 s."""
    return stream(0, "spikes").poisson(mixed_cells(WALK) * RATE * 0.05)


@pytest.fixture(scope="module")
def sums(spikes: np.ndarray) -> BinnedSums:
    """Sums whose rates are in spikes/s."""
    return bin_activity(*WALK, spikes / 0.05, EDGES, EDGES, 36)


@pytest.fixture(scope="module")
def theirs(opexebo: ModuleType, spikes: np.ndarray) -> tuple[list[np.ma.MaskedArray], np.ma.MaskedArray]:
    """opexebo's unsmoothed maps and occupancy."""
    keys = {"bin_edges": (EDGES, EDGES), "limits": (0.0, 1.0, 0.0, 1.0)}
    occupancy, _, _ = _quietly(opexebo.analysis.spatial_occupancy, WALK.time, WALK.truth.T[:2], 1.0, **keys)
    maps = []
    for count in spikes.T:
        tracking = np.repeat(np.column_stack([WALK.time, WALK.truth[:, :2]]), count, axis=0).T
        maps.append(_quietly(opexebo.analysis.rate_map, occupancy, tracking, 1.0, **keys))
    return maps, occupancy


def _each(stats: Iterator[dict[str, float]], name: str) -> list[float]:
    return [float(each[name]) for each in stats]


def test_occupancy_and_maps_are_those_of_opexebo(sums: BinnedSums, theirs: tuple) -> None:
    maps, occupancy = theirs
    assert_allclose(sums.seconds, occupancy.filled(0), atol=1e-9)
    assert_allclose(rate_maps(sums, 0.0, 1e-3), [each.filled(np.nan) for each in maps], rtol=1e-9)


@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.0])
def test_smoothing_is_that_of_opexebo(
    opexebo: ModuleType, sums: BinnedSums, theirs: tuple, sigma: float
) -> None:
    """Its two conventions: bins without a rate count as 0, or are ignored (`mask_fill=nan`)."""
    rates = rate_maps(sums, 0.0, 1e-3)
    rates[:, 4:6, 7] = np.nan
    known = np.isfinite(rates)
    filled = smooth_plane(np.nan_to_num(rates), sigma)
    ignored = smooth_rates(rates, np.ones((20, 20)), sigma)
    for mine, fill in ((filled, 0.0), (ignored, np.nan)):
        for cell in (0, 8):
            masked = np.ma.masked_invalid(rates[cell])
            other = _quietly(opexebo.general.smooth, masked, sigma, mask_fill=fill)
            assert_allclose(mine[cell][known[cell]], other.compressed(), rtol=1e-6)


def test_sums_and_seconds_smoothed_apart_are_two_smooths_of_opexebo(
    opexebo: ModuleType, sums: BinnedSums
) -> None:
    smooth = opexebo.general.smooth
    other = _quietly(smooth, sums.place[3], 1.5) / _quietly(smooth, sums.seconds, 1.5)
    visited = sums.seconds >= 0.1
    assert_allclose(rate_maps(sums, 1.5)[3][visited], other[visited], rtol=1e-6)


def test_map_statistics_are_those_of_opexebo(opexebo: ModuleType, sums: BinnedSums) -> None:
    rates = rate_maps(sums, 1.5)
    seconds = np.ma.masked_where(np.isnan(rates[0]), sums.seconds)
    stats = [_quietly(opexebo.analysis.rate_map_stats, np.ma.masked_invalid(each), seconds) for each in rates]
    content = information_above_mean(rates, sums.seconds)
    assert_allclose(content, _each(iter(stats), "spatial_information_content"), atol=1e-6)
    assert_allclose(sparsity(rates, sums.seconds), _each(iter(stats), "sparsity"), atol=1e-6)
    assert_allclose(selectivity(rates, sums.seconds), _each(iter(stats), "selectivity"), atol=1e-6)
    assert_allclose(peak_rate(rates, sums.seconds), _each(iter(stats), "peak_rate"), atol=1e-6)


def test_coherence_is_that_of_opexebo_within_a_frame_of_zeros(opexebo: ModuleType, sums: BinnedSums) -> None:
    rates = np.nan_to_num(rate_maps(sums, 0.0))
    padded = np.pad(rates, ((0, 0), (1, 1), (1, 1)))
    mine = correlate(rates, neighbour_means(padded)[:, 1:-1, 1:-1])
    theirs = [_quietly(opexebo.analysis.rate_map_coherence, np.ma.masked_invalid(each)) for each in rates]
    assert_allclose(mine, theirs, atol=1e-6)


def test_tuning_is_that_of_opexebo(opexebo: ModuleType, sums: BinnedSums, spikes: np.ndarray) -> None:
    """Its first bin begins at angle 0; ours is centred there, so its headings are given half a bin more."""
    half = np.pi / 36
    heading = (WALK.truth[:, 2] + half) % (2 * np.pi)
    curves = tuning_curves(sums)
    occupancy, _ = np.histogram(heading, np.linspace(0, 2 * np.pi, 37))
    occupancy = np.ma.masked_equal(occupancy * 0.05, 0)
    for cell in (0, 6, 7, 8):
        at = np.repeat(heading, spikes[:, cell])
        curve = _quietly(opexebo.analysis.tuning_curve, occupancy, at, bin_width=10.0)
        assert_allclose(curves[cell], curve.filled(np.nan), atol=1e-6)
        stats = _quietly(opexebo.analysis.tuning_curve_stats, curve)
        one = curves[cell : cell + 1], sums.heading_seconds
        assert_allclose(mean_vector_length(*one), stats["hd_mvl"], atol=1e-6)
        assert_allclose(peak_rate(*one), stats["hd_peak_rate"], atol=1e-6)
        turn = preferred_direction(*one) + half - stats["hd_mean_direction_rad"]
        assert_allclose(np.exp(1j * turn), 1, atol=1e-6)


@pytest.mark.parametrize("share", [0.2, 0.3, 0.6])
def test_border_score_is_that_of_opexebo(opexebo: ModuleType, sums: BinnedSums, share: float) -> None:
    """Given the same fields."""
    rates = rate_maps(sums, 1.5)
    rates[8, 3:6, 0] = np.nan  # the border cell, with gaps beside its wall
    fields = find_fields(rates, share)
    for cell, score in enumerate(score_borders(rates, fields)):
        other = border_score(opexebo, rates, fields, cell)
        assert_allclose(score, other, atol=1e-6)


@pytest.mark.parametrize("spots", [[(5, 5)], [(4, 14), (14, 5)], [(3, 3), (16, 3), (9, 16)]])
def test_separate_fields_are_those_of_opexebo(opexebo: ModuleType, spots: list[tuple[int, int]]) -> None:
    """Its search, given the peaks, ends at 0.2 of the peak of the map opened by a disk of radius 1."""
    morphology = _import("skimage.morphology")
    y, x = np.mgrid[:20, :20]
    rates = np.stack([20 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 8) for b, a in spots]).sum(axis=0)
    keys = {"min_peak": 0.0, "min_mean": 0.0, "peak_coords": np.array(spots)}
    other, label = _quietly(opexebo.analysis.place_field, rates, **keys)
    opened = morphology.reconstruction(morphology.erosion(rates, morphology.disk(1)), rates)
    fields = find_fields(rates[None], 0.2 * opened.max() / rates.max())
    assert len(fields.cell) == len(other) == len(spots)
    assert ((fields.label[0] > 0) == (label > 0)).all()
    assert sorted(fields.bins) == sorted(each["area"] for each in other)
    assert_allclose(sorted(fields.peak), sorted(each["peak_rate"] for each in other), atol=1e-6)


def test_information_is_that_of_pynapple(sums: BinnedSums) -> None:
    pynapple = _import("pynapple")
    curves, maps = tuning_curves(sums), rate_maps(sums, 1.5)
    for rates, seconds in ((maps, sums.seconds), (curves, sums.heading_seconds)):
        found = mutual_information(pynapple, rates, seconds)
        assert_allclose(information(rates, seconds), found["bits/spike"], atol=1e-6)
        assert_allclose(information_rate(rates, seconds), found["bits/sec"], atol=1e-6)
