"""Laws of the likelihoods, and consequences of their printed forms."""

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
from tests.helpers.grid_world import LENGTH

CONFIG = LikelihoodConfig()
PRIOR = 0.3
SEGMENTS = 5
MODELS = {"literal": lambda cell, hits: np.ones(cell.shape[:-1], bool), "distinct": distinct_cells}
EVIDENCE = st.floats(-30, 30)

free = jax.jit(likelihoods.free_space, static_argnums=0)
contact = jax.jit(likelihoods.contact, static_argnums=0)
direction = jax.jit(likelihoods.wall_direction, static_argnums=0)
weighing = jax.jit(likelihoods.printed_likelihood, static_argnums=0)


def printed(counted, evidence, cell, hits, alive=None):
    """[N] log-likelihoods; all whiskers report unless `alive` is given."""
    alive = np.ones_like(hits) if alive is None else alive
    return weighing(PRIOR, evidence, hits, counted(cell, hits) & alive[None, :, None])


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


def walls(model, chance, whiskers):
    """Likelihood ratio of contacts on cells of this chance and on unknown ones; shafts are unknown."""
    cell = np.tile(np.arange(SEGMENTS)[None, :, None], (whiskers, 1, 2)).astype(float)[None]
    evidence = np.zeros((2, whiskers, SEGMENTS))
    evidence[1, :, -1] = logit(chance) - logit(PRIOR)
    cell = np.tile(cell, (2, 1, 1, 1))
    unknown, known = np.exp(printed(MODELS[model], evidence, cell, np.ones(whiskers, bool)))
    return known / unknown


# Eq. 1 and 2


def test_as_printed_two_contacts_contradict_a_correct_map():
    """On a mapped wall (0.9) their likelihood is (0.9 * 0.1 / 0.3 / 0.7) ** 2 = 0.18 of that on unexplored
    cells (0.3)."""
    assert walls("literal", 0.9, 2) == pytest.approx(0.1837, abs=1e-4)
    assert walls("distinct", 0.9, 2) == pytest.approx(9)


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
    logs = printed(MODELS[model], evidence, cell, hits, alive)
    expected = [by_loops(model, evidence[k], cell[k], hits, alive) for k in range(2)]
    assert np.exp(logs) == pytest.approx(expected)


def test_the_last_free_point_in_the_contact_cell_does_not_count():
    cell = np.array([0, 1, 2, 3, 3.0]).repeat(2).reshape(1, 1, SEGMENTS, 2)
    evidence = np.array([0, 0, 0, 9, 9.0]).reshape(1, 1, SEGMENTS)
    logs = {
        name: float(printed(config, evidence, cell, np.ones(1, bool))[0]) for name, config in MODELS.items()
    }
    wall = expit(9 + logit(PRIOR))
    assert np.exp(logs["distinct"]) == pytest.approx(0.7**3 * wall)
    assert np.exp(logs["literal"]) == pytest.approx(0.7**3 * wall * (1 - wall) ** 2)


def test_five_points_on_a_whisker_hit_three_to_four_cells():
    """Size: 3.45 cells on average and 0.39 of last points in the contact's cell, over 4 000 poses, each
    within 4 standard errors and the last digit: 1e-4."""
    count = 4000
    stream = np.random.default_rng(0)
    base, angle = stream.uniform(0, 1, (count, 1, 2)), stream.uniform(0, 2 * np.pi, count)
    shaft = LENGTH / 0.05 * (1 + np.arange(SEGMENTS)) / SEGMENTS
    cell = np.round(base + shaft[None, :, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None])[
        :, None
    ]
    flat = np.full((count, 1, SEGMENTS), -logit(PRIOR))  # every cell halves the likelihood
    half = {
        name: np.rint(-np.asarray(printed(config, flat, cell, np.zeros(1, bool))) / np.log(2))
        for name, config in MODELS.items()
    }
    assert (half["literal"] == SEGMENTS).all()
    assert half["distinct"].mean() == pytest.approx(
        3.45, abs=0.005 + 4 * half["distinct"].std() / np.sqrt(count)
    )
    touched = np.rint(-np.asarray(printed(MODELS["distinct"], flat, cell, np.ones(1, bool))) / np.log(2))
    assert np.array_equal(touched, half["distinct"])  # one cell is the contact's instead
    last = np.all(cell[:, 0, -1] == cell[:, 0, -2], axis=1).mean()
    assert last == pytest.approx(0.39, abs=0.005 + 4 * 0.5 / np.sqrt(count))


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_certain_cells_leave_printed_likelihoods_finite(model, dtype):
    cell = np.arange(SEGMENTS, dtype=dtype)[None, None, :, None].repeat(2, 3)
    for sign in (-1, 1):
        for hits in (False, True):
            evidence = np.full((1, 1, SEGMENTS), sign * 1e4, dtype)
            logs = printed(MODELS[model], evidence, cell, np.array([hits]))
            assert logs.dtype == dtype
            assert np.isfinite(logs).all()


# Corrections to the paper


@given(st.lists(EVIDENCE, min_size=4, max_size=4), st.lists(st.booleans(), min_size=4, max_size=4))
def test_free_points_multiply_chances_of_no_obstacle(evidence, among):
    logs = free(CONFIG, np.array([evidence]), np.array(among))
    chance = expit(np.array(evidence) + logit(CONFIG.unexplored))
    assert logs == pytest.approx(CONFIG.free * np.log1p(-chance) @ np.array(among), rel=1e-6, abs=1e-9)


@given(st.lists(EVIDENCE, min_size=4, max_size=4), st.lists(st.booleans(), min_size=4, max_size=4))
def test_contacts_multiply_chances_of_an_obstacle_or_of_a_surprise(evidence, among):
    logs = contact(CONFIG, np.array([evidence]), np.array(among))
    chance = expit(np.array(evidence) + logit(CONFIG.unexplored))
    surprise = CONFIG.surprise
    expected = CONFIG.contact * np.log(surprise + (1 - surprise) * chance) @ np.array(among)
    assert logs == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert CONFIG.contact * np.log(surprise) * sum(among) - 1e-9 <= logs[0] <= 1e-9


@given(EVIDENCE, st.floats(0.01, 5))
def test_the_likelihood_of_a_contact_rises_with_the_chance_of_an_obstacle(evidence, more):
    both, one = np.array([[evidence], [evidence + more]]), np.ones(1, bool)
    emptier, fuller = free(CONFIG, both, one)
    assert emptier >= fuller
    less, most = contact(CONFIG, both, one)
    assert less <= most
    if abs(evidence) < 5:
        assert emptier > fuller
        assert less < most


def test_unexplored_space_carries_almost_no_evidence():
    """In contrast to a map that gives it an obstacle probability of 30 %."""
    logs = free(CONFIG, np.zeros((1, 17)), np.ones(17, bool))
    assert -0.03 < logs[0] < 0
    assert free(CONFIG, np.zeros((1, 0)), np.zeros(0, bool)) == 0
    assert contact(CONFIG, np.zeros((1, 0)), np.zeros(0, bool)) == 0


# Directions of walls


@pytest.mark.parametrize("precision", [0.01, 0.16, 1.0, 3.0, 9.0])
def test_a_direction_is_likeliest_along_the_field_and_the_same_about_it(precision):
    angle = np.linspace(-np.pi, np.pi, 73)
    for at in (0.0, 1.0, -2.5):
        field = np.tile(20 * np.array([np.cos(at), np.sin(at)]), (73, 1))
        logs = np.asarray(direction(CONFIG, field, angle + at, jnp.asarray(precision)))
        assert logs.argmax() == 36
        assert logs == pytest.approx(logs[::-1], abs=1e-9)
        assert (np.diff(logs[36:]) < 0).all()


@pytest.mark.parametrize("precision", [0.16, 1.0, 9.0])
def test_without_a_wall_all_directions_are_equally_likely(precision):
    angle = np.linspace(-np.pi, np.pi, 73)
    logs = direction(CONFIG, np.zeros((73, 2)), angle, jnp.asarray(precision))
    assert logs == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("length", [0.1, 1.0, 100.0])
@pytest.mark.parametrize("precision", [0.01, 0.16, 0.5, 1.0, 3.0, 9.0])
def test_a_known_direction_does_not_raise_the_mean_likelihood(length, precision):
    """The mean over all directions is about 1, so that maps are not favoured for having walls."""
    angle = np.arange(360) * np.pi / 180
    field = np.tile([0.6 * length, 0.8 * length], (360, 1))
    likely = np.exp(direction(CONFIG, field, angle, jnp.asarray(precision)))
    assert likely.mean() == pytest.approx(1, abs=0.2)
    assert likely.min() >= (1 - CONFIG.wall) - 1e-9


def test_a_direction_carries_more_evidence_with_more_walls():
    angle = np.zeros(5)
    length = np.array([0.0, 0.2, 1.0, 5.0, 100.0])
    aligned = np.asarray(direction(CONFIG, np.stack([length, 0 * length], axis=1), angle, jnp.asarray(9.0)))
    opposed = np.asarray(direction(CONFIG, np.stack([-length, 0 * length], axis=1), angle, jnp.asarray(9.0)))
    assert (np.diff(aligned) > 0).all()
    assert (np.diff(opposed) < 0).all()
