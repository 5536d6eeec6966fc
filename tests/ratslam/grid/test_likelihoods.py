"""Laws of the likelihoods and of footprints, as formulas in NumPy, and consequences of printed forms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit, logit

from evaluation.papers.trial_sessions import distinct_cells
from ratslam.grid import likelihoods
from ratslam.grid.config import LikelihoodConfig
from tactile.base.se2 import wrap

CONFIG = LikelihoodConfig()
PRIOR = 0.3
SEGMENTS = 5
MODELS = {"literal": lambda cell, hits: np.ones(cell.shape[:-1], bool), "distinct": distinct_cells}
EVIDENCE = st.lists(st.floats(-30, 30), min_size=4, max_size=4)
AMONG = st.lists(st.booleans(), min_size=4, max_size=4)

free = jax.jit(likelihoods.free_space, static_argnums=0)
contact = jax.jit(likelihoods.contact, static_argnums=0)
direction = jax.jit(likelihoods.wall_direction, static_argnums=0)
weighing = jax.jit(likelihoods.printed_likelihood, static_argnums=0)


def printed(model, evidence, cell, hits, alive=None):
    """[N] log-likelihoods; all whiskers report unless `alive` is given."""
    alive = np.ones_like(hits) if alive is None else alive
    return weighing(PRIOR, evidence, hits, MODELS[model](cell, hits) & alive[None, :, None])


def by_loops(model, evidence, cell, hits, alive):
    """Eq. 1 and 2 of one particle, written out."""
    chance = expit(evidence + logit(PRIOR))
    product = 1.0
    for whisker in np.flatnonzero(alive):
        ends = tuple(cell[whisker, -1])
        points = range(SEGMENTS)
        if hits[whisker]:
            product *= chance[whisker, -1]
            if model != "literal":
                points = range(SEGMENTS - 1)
        passed = set()
        for k in points:
            here = tuple(cell[whisker, k])
            if model == "distinct" and (here in passed or (hits[whisker] and here == ends)):
                continue
            passed.add(here)
            product *= 1 - chance[whisker, k]
    return product


# Eq. 1 and 2


@pytest.mark.parametrize("model", MODELS)
@given(st.integers(0, 2**32 - 1))
def test_printed_likelihoods_are_the_products_of_eq_1_and_2(model, seed):
    stream = np.random.default_rng(seed)
    evidence = stream.normal(0, 2, (2, 3, SEGMENTS))
    cell = np.cumsum(stream.integers(0, 2, (2, 3, SEGMENTS, 2)), axis=2).astype(float)
    for k, c in np.ndindex(2, 3):  # the same cell, the same evidence
        _, index = np.unique(cell[k, c], axis=0, return_inverse=True)
        evidence[k, c] = evidence[k, c][index.ravel()]
    alive = stream.random(3) < 0.8
    hits = (stream.random(3) < 0.5) & alive
    logs = printed(model, evidence, cell, hits, alive)
    expected = [by_loops(model, evidence[k], cell[k], hits, alive) for k in range(2)]
    assert np.exp(logs) == pytest.approx(expected)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_certain_cells_leave_printed_likelihoods_finite(model, dtype):
    cell = np.arange(SEGMENTS, dtype=dtype)[None, None, :, None].repeat(2, 3)
    for sign in (-1, 1):
        for hits in (False, True):
            logs = printed(model, np.full((1, 1, SEGMENTS), sign * 1e4, dtype), cell, np.array([hits]))
            assert logs.dtype == dtype
            assert np.isfinite(logs).all()


# Corrections to the paper


@given(EVIDENCE, AMONG)
def test_points_multiply_chances_of_no_obstacle_and_contacts_those_of_one_or_of_a_surprise(evidence, among):
    chance = expit(np.array(evidence) + logit(CONFIG.unexplored))
    expected = CONFIG.free * np.log1p(-chance) @ np.array(among)
    assert free(CONFIG, np.array([evidence]), np.array(among)) == pytest.approx(expected, rel=1e-6, abs=1e-9)
    surprise = CONFIG.surprise
    expected = CONFIG.contact * np.log(surprise + (1 - surprise) * chance) @ np.array(among)
    assert contact(CONFIG, np.array([evidence]), np.array(among)) == pytest.approx(
        expected, rel=1e-6, abs=1e-9
    )


def test_unexplored_space_carries_almost_no_evidence():
    """In contrast to a map that gives it an obstacle probability of 30 %."""
    assert -0.03 < free(CONFIG, np.zeros((1, 17)), np.ones(17, bool))[0] < 0
    assert free(CONFIG, np.zeros((1, 0)), np.zeros(0, bool)) == 0
    assert contact(CONFIG, np.zeros((1, 0)), np.zeros(0, bool)) == 0


# Directions of walls


@given(st.floats(0, 100), st.floats(-10, 10), st.floats(-10, 10), st.floats(0.01, 9))
def test_a_direction_is_as_likely_as_its_von_mises_density_with_the_weight_of_the_walls(
    length, at, angle, precision
):
    field = length * np.array([[np.cos(at), np.sin(at)]])
    known = length / (length + 0.5)
    density = np.sqrt(2 * np.pi * max(precision, 0.16)) * np.exp(precision * (np.cos(angle - at) - 1))
    expected = np.log(1 - CONFIG.wall * known + CONFIG.wall * known * density)
    found = direction(CONFIG, field, np.array([angle]), jnp.asarray(precision))
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-9)


# Footprints

SIZE = 31
PLACE = st.tuples(*[st.floats(10, 20)] * 2)
ANGLE = st.floats(-10, 10)
FAN = np.pi / 12

blobs = jax.jit(likelihoods.gaussian_blobs, static_argnums=(2, 3))
disc = jax.jit(likelihoods.disc, static_argnums=2)
edge = jax.jit(lambda place, angle: likelihoods.wall_edge(place, angle, 4.0, 1.2, SIZE))
sector = jax.jit(lambda place, angle: likelihoods.wall_sector(place, angle, 5.0, FAN, SIZE))


def offsets(place):
    """To the right [1, SIZE] and up [SIZE, 1] of a place, cells."""
    at = np.arange(SIZE)
    return at[None] - place[0], at[:, None] - place[1]


@given(st.lists(PLACE, min_size=3, max_size=3), st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_blobs_are_sums_of_round_gaussians(places, amounts):
    expected = np.zeros((SIZE, SIZE))
    for place, amount in zip(places, amounts, strict=True):
        right, up = offsets(place)
        expected += amount * np.exp(-(right**2 + up**2) / (2 * 1.5**2))
    found = np.asarray(blobs(np.array([places, places[::-1]]), np.array(amounts), 1.5, SIZE))
    assert found[0] == pytest.approx(expected, abs=1e-12)
    assert not np.any(blobs(np.zeros((4, 0, 2)), np.zeros(0), 1.0, SIZE))


@given(PLACE, st.floats(1.0, 6.0))
def test_a_disc_is_full_inside_and_falls_over_a_cell_at_its_rim(place, radius):
    away = np.hypot(*offsets(place))
    found = disc(np.array([place]), radius, SIZE)[0]
    assert found == pytest.approx(np.clip(radius + 0.5 - away, 0, 1), abs=1e-12)


@given(PLACE, ANGLE)
def test_an_edge_is_a_gaussian_along_the_wall(place, angle):
    right, up = offsets(place)
    along, across = np.cos(angle) * right + np.sin(angle) * up, np.cos(angle) * up - np.sin(angle) * right
    expected = np.exp(-(along**2) / (2 * 4.0**2) - across**2 / (2 * 1.2**2))
    assert edge(np.array([place]), np.array([angle]))[0] == pytest.approx(expected, abs=1e-12)


@given(st.one_of(PLACE, st.just((15.0, 15.0))), ANGLE)
def test_eq_4_draws_the_edge_both_ways(place, angle):
    """Read as printed, without the modulus, the way back has almost no mass."""
    right, up = offsets(place)
    away, seen = np.hypot(right, up), np.arctan2(up, right)
    off = np.minimum(np.abs(wrap(seen - angle)), np.abs(wrap(seen - angle + np.pi)))
    expected = np.exp(-(away**2) / (2 * 5.0**2) - np.where(away > 0, off, 0.0) ** 2 / (2 * FAN**2))
    assert sector(np.array([place]), np.array([angle]))[0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_kernels_keep_their_precision(dtype):
    place, angle, amount = np.full((2, 2), 3.0, dtype), np.ones(2, dtype), np.ones(1, dtype)
    for make, *parts in (
        (lambda place, amount: likelihoods.gaussian_blobs(place[:, None], amount, 1.0, 8), place, amount),
        (lambda place: likelihoods.disc(place, 2.0, 8), place),
        (lambda place, angle: likelihoods.wall_edge(place, angle, 3.0, 1.0, 8), place, angle),
        (lambda place, angle: likelihoods.wall_sector(place, angle, 3.0, FAN, 8), place, angle),
    ):
        footprint = jax.eval_shape(make, *parts)
        assert (footprint.dtype, footprint.shape) == (dtype, (2, 8, 8))
