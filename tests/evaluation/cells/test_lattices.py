"""Autocorrelograms, lattice scores and spacings: against opexebo, and on lattices of known shape."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluation.cells.grid_score import (
    HEXAGONAL,
    SQUARE,
    autocorrelogram,
    centre_radii,
    lattice_scores,
    measure_lattice,
)
from evaluation.papers.cells.agreement import grid_score, quiet
from tactile.base.errors import InputError
from tests.evaluation.cells.box_walk import lattice_map, mixed_maps

SEEDS = st.integers(0, 10**6)


def correlate(image: np.ndarray, lag: tuple[int, int]) -> float:
    """Pearson correlation over the common bins, bin by bin."""
    pairs = [
        (image[y, x], image[y + lag[0], x + lag[1]])
        for y, x in np.ndindex(image.shape)
        if 0 <= y + lag[0] < image.shape[0] and 0 <= x + lag[1] < image.shape[1]
    ]
    left, right = np.array([pair for pair in pairs if np.isfinite(pair).all()]).T
    return float(np.corrcoef(left, right)[0, 1])


@given(SEEDS, st.integers(0, 12))
def test_an_autocorrelogram_is_the_correlation_over_common_visited_bins(seed, holes):
    rng = np.random.default_rng(seed)
    image = rng.random((8, 9))
    image.ravel()[rng.choice(72, holes, replace=False)] = np.nan
    result = autocorrelogram(image[None])[0]
    assert result.shape == (13, 15)
    for lag in ((0, 0), (1, -2), (-3, 4), (0, 5), (2, 1)):
        assert result[6 + lag[0], 7 + lag[1]] == pytest.approx(correlate(image, lag), abs=1e-9)


def test_lags_with_few_common_bins_and_flat_maps_have_no_correlation():
    image = np.random.default_rng(0).random((20, 20))
    half = image.copy()
    half[:, 10:] = np.nan
    result = autocorrelogram(np.array([image, half, np.full((20, 20), 3.0), np.full((20, 20), np.nan)]))
    assert np.isfinite(result[0]).all()
    assert np.isnan(result[1][:, [0, 34]]).all()
    assert np.isfinite(result[1][:, 10:25]).all()
    assert np.isnan(result[2:]).all()


@pytest.mark.parametrize(
    "shape", [(20, 20), (17, 21), (12, 13), pytest.param((40, 40), marks=pytest.mark.soak)]
)
def test_autocorrelograms_and_grid_scores_equal_those_of_opexebo(shape):
    with quiet():
        opexebo = pytest.importorskip("opexebo")
    maps = mixed_maps(400 if shape == (40, 40) else 12, shape, seed=2)
    found = autocorrelogram(maps)
    expected = np.array([grid_score(opexebo, image) for image in found])
    np.testing.assert_allclose(lattice_scores(found), expected, atol=1e-6, rtol=0)
    assert np.isfinite(expected).mean() > 0.7
    maps[0, 3:6, 2] = np.nan
    theirs = np.array([opexebo.analysis.autocorrelation(image) for image in maps])
    np.testing.assert_allclose(autocorrelogram(np.nan_to_num(maps)), theirs, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("directions", "lattice", "other"), [(3, HEXAGONAL, SQUARE), (2, SQUARE, HEXAGONAL)])
@given(st.floats(7, 8), st.floats(0, np.pi))
def test_a_lattice_has_its_score_spacing_and_orientation(directions, lattice, other, spacing, turn):
    maps = autocorrelogram(lattice_map(directions, spacing, turn, (30, 30))[None])
    assert lattice_scores(maps, lattice)[0] > 1
    assert lattice_scores(maps, other)[0] < 0.5
    found, orientation = measure_lattice(maps, 0.05, lattice)
    period = np.pi / directions
    assert found[0] == pytest.approx(0.05 * spacing, rel=0.04)
    error = (orientation[0] - turn + period / 2) % period - period / 2
    assert abs(error) < np.deg2rad(3)
    assert 0 <= orientation[0] <= period


def test_each_map_is_scored_by_itself():
    maps = autocorrelogram(mixed_maps(300, (12, 12), seed=4))
    alone = [lattice_scores(maps[i : i + 1])[0] for i in (0, 1, 130, 299)]
    np.testing.assert_allclose(lattice_scores(maps)[[0, 1, 130, 299]], alone, atol=1e-12)
    assert lattice_scores(maps[:0]).shape == (0,)


def test_a_map_without_a_lattice_has_neither_score_nor_spacing():
    point, y, x = np.zeros((20, 20)), *np.mgrid[:20, :20]
    point[9, 9] = 1
    bump = np.exp(-((x - 9.0) ** 2 + (y - 9.0) ** 2) / 8)
    maps = autocorrelogram(np.array([np.full((20, 20), 2.0), point, np.full((20, 20), np.nan), bump]))
    assert np.isnan(lattice_scores(maps)[:3]).all()
    assert np.isnan(measure_lattice(maps, 0.05)).all()


def test_the_radius_of_the_centre_is_that_of_its_bump():
    y, x = np.mgrid[-17:18, -17:18]
    widths = np.array([1.5, 3.0, 5.0])
    radii = centre_radii(np.exp(-(x**2 + y**2)[..., None] / 2 / widths**2))
    np.testing.assert_allclose(radii, np.floor(np.sqrt(2 * np.log(1 / 0.2)) * widths), atol=1)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        (lambda: autocorrelogram(np.zeros((20, 20))), "maps"),
        (lambda: autocorrelogram(np.zeros((3, 0, 20))), "maps"),
        (lambda: lattice_scores(np.zeros((2, 20, 21))), "odd"),
        (lambda: measure_lattice(np.zeros((2, 21, 21)), 0.0), "bin_size"),
    ],
)
def test_other_arrays_are_refused(wrong, named):
    with pytest.raises(InputError, match=named):
        wrong()
