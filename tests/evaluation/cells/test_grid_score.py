"""Lattice scores: against opexebo, and on lattices of known shape."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluation.cells.grid_score import HEXAGONAL, SQUARE, autocorrelogram, centre_radii, lattice_scores
from evaluation.papers.cells.agreement import grid_score, quiet
from tactile.base.errors import InputError
from tests.evaluation.cells.lattice_maps import lattice_map, mixed_maps


@pytest.fixture
def opexebo_score() -> Callable[[np.ndarray], float]:
    """The grid score of opexebo of an autocorrelogram."""
    with quiet():
        opexebo = pytest.importorskip("opexebo")
    return partial(grid_score, opexebo)


def compare(score: Callable[[np.ndarray], float], count: int, shape: tuple[int, int], seed: int) -> None:
    maps = autocorrelogram(mixed_maps(count, shape, seed))
    expected = np.array([score(image) for image in maps])
    np.testing.assert_allclose(lattice_scores(maps), expected, atol=1e-6, rtol=0)
    assert np.isfinite(expected).mean() > 0.7


@pytest.mark.parametrize("shape", [(20, 20), (17, 21), (12, 13)])
def test_the_grid_score_equals_opexebo(opexebo_score, shape):
    compare(opexebo_score, 12, shape, seed=2)


@pytest.mark.soak
@pytest.mark.parametrize("shape", [(20, 20), (17, 21), (12, 13), (40, 40), (6, 6)])
def test_the_grid_score_equals_opexebo_on_many_maps(opexebo_score, shape):
    compare(opexebo_score, 400, shape, seed=3)


@given(spacing=st.floats(6, 8), turn=st.floats(0, np.pi))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_each_lattice_has_a_high_score_of_its_own_and_a_low_one_of_the_other(spacing, turn):
    lattices = [lattice_map(directions, spacing, turn, (24, 24)) for directions in (3, 2)]
    maps = autocorrelogram(np.array(lattices))
    hexagonal, square = lattice_scores(maps, HEXAGONAL), lattice_scores(maps, SQUARE)
    assert hexagonal[0] > 1
    assert square[0] < 0.5
    assert square[1] > 1
    assert hexagonal[1] < 0


@given(seed=st.integers(0, 10**6), scale=st.floats(0.01, 100))
@settings(max_examples=15, deadline=None, derandomize=True)
def test_quarter_turns_mirrors_and_scale_keep_the_score(seed, scale):
    maps = mixed_maps(4, (20, 20), seed)
    score = lattice_scores(autocorrelogram(maps))
    turned = np.array([np.rot90(image) for image in maps]) * scale
    np.testing.assert_allclose(lattice_scores(autocorrelogram(turned)), score, atol=1e-6)
    transposed = lattice_scores(autocorrelogram(maps.transpose(0, 2, 1)))
    np.testing.assert_allclose(transposed, score, atol=0.05)


def test_each_map_is_scored_by_itself():
    maps = autocorrelogram(mixed_maps(300, (12, 12), seed=4))
    scores = lattice_scores(maps)
    alone = [lattice_scores(maps[i : i + 1])[0] for i in (0, 1, 130, 299)]
    np.testing.assert_allclose(scores[[0, 1, 130, 299]], alone, atol=1e-12)
    assert lattice_scores(maps[:0]).shape == (0,)


def test_a_map_without_a_lattice_to_score_is_nan():
    point = np.zeros((20, 20))
    point[9, 9] = 1
    flat = np.full((20, 20), 2.0)
    slope = np.tile(np.arange(20.0), (20, 1))
    scores = lattice_scores(autocorrelogram(np.array([flat, point, slope, np.full((20, 20), np.nan)])))
    assert np.isnan(scores[[0, 1, 3]]).all()


def test_the_radius_of_the_centre_is_that_of_its_bump():
    y, x = np.mgrid[-17:18, -17:18]
    bumps = [np.exp(-(x**2 + y**2) / 2 / width**2) for width in (1.5, 3.0, 5.0)]
    radii = centre_radii(np.stack(bumps, axis=-1))
    np.testing.assert_allclose(
        radii, np.floor(np.sqrt(2 * np.log(1 / 0.2)) * np.array([1.5, 3.0, 5.0])), atol=1
    )


def test_sides_must_be_odd():
    with pytest.raises(InputError, match="odd"):
        lattice_scores(np.zeros((2, 20, 21)))
