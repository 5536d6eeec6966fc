"""Laws of resampling: numbers of copies, survivors, copied rows, jitter."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chisquare

from ratslam.grid import particles
from ratslam.grid.config import ResamplingConfig
from tests.ratslam.grid.particle_cases import COUNT, MULTINOMIAL, SYSTEMATIC, placed, swarm

WEIGHTS = st.lists(st.sampled_from([0.0, 1e-9, 0.01, 0.3, 1.0, 1.0, 7.0]), min_size=COUNT, max_size=COUNT)
drawing = jax.jit(particles.resample, static_argnums=0)


def drawn(config, share, seed):
    return jax.tree.map(np.asarray, drawing(config, share, jax.random.key(seed)))


def copies(resampling):
    return np.bincount(resampling.ancestor, minlength=len(resampling.ancestor))


@given(WEIGHTS.filter(any), st.integers(0, 2**32 - 1))
def test_systematic_copies_are_within_one_of_the_share(weights, seed):
    share = np.array(weights) / sum(weights)
    count = copies(drawn(SYSTEMATIC, share, seed))
    assert (count >= np.floor(COUNT * share - 1e-9)).all()
    assert (count <= np.ceil(COUNT * share + 1e-9)).all()
    assert count.sum() == COUNT


@given(st.lists(st.integers(0, COUNT - 1), min_size=COUNT, max_size=COUNT))
def test_survivors_stay_and_the_others_are_replaced(parents):
    offspring = np.bincount(parents, minlength=COUNT)
    resampling = placed(offspring)
    slots = np.arange(COUNT)
    assert np.array_equal(copies(resampling), offspring)
    assert np.array_equal(resampling.ancestor == slots, offspring > 0)
    assert resampling.copies == (offspring == 0).sum()
    source, target = resampling.source[: resampling.copies], resampling.target[: resampling.copies]
    assert np.array_equal(target, slots[offspring == 0])
    assert np.array_equal(resampling.ancestor[target], source)


@given(WEIGHTS.filter(any), st.integers(0, 2**32 - 1), st.sampled_from([SYSTEMATIC, MULTINOMIAL]))
def test_particles_without_weight_have_no_copies(weights, seed, config):
    share = np.array(weights) / sum(weights)
    assert not copies(drawn(config, share, seed))[share == 0].any()


@pytest.mark.parametrize("shape", [(COUNT,), (COUNT, 3, 4, 5)])
def test_rows_are_copied_from_the_ancestors(shape):
    stream = np.random.default_rng(0)
    rows = stream.random(shape)
    for seed in range(20):
        resampling = drawn(SYSTEMATIC, stream.dirichlet(np.full(COUNT, 0.2)), seed)
        assert resampling.copies > 0
        after = jax.jit(particles.copy_rows)(rows, resampling)
        assert np.array_equal(after, rows[resampling.ancestor])


@pytest.mark.parametrize("config", [SYSTEMATIC, MULTINOMIAL], ids=["systematic", "multinomial"])
@pytest.mark.parametrize("heavy", [0, 7, COUNT - 1])
def test_one_heavy_particle_takes_all(config, heavy):
    share = np.zeros(COUNT)
    share[heavy] = 1
    for seed in range(10):
        resampling = drawn(config, share, seed)
        assert (resampling.ancestor == heavy).all()
        assert resampling.copies == COUNT - 1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("count", [2, 30, 100])
def test_equal_weights_change_nothing(count, dtype):
    share = np.asarray(particles.normalised_weights(jnp.full(count, -3.0, dtype)))
    for seed in range(10):
        resampling = drawn(SYSTEMATIC, share, seed)
        assert resampling.copies == 0
        assert np.array_equal(resampling.ancestor, np.arange(count))


def test_a_last_particle_of_weight_0_is_never_drawn():
    """With so many particles that in float32 the last systematic point is often rounded up to 1."""
    count = 100_000
    share = particles.normalised_weights(jnp.zeros(count, np.float32).at[-1].set(-jnp.inf))
    assert share[-1] == 0
    assert all(
        drawn(SYSTEMATIC, share, seed).ancestor[-1] != count - 1 for seed in [*range(20), 65, 178, 881]
    )


@pytest.mark.parametrize("config", [SYSTEMATIC, MULTINOMIAL], ids=["systematic", "multinomial"])
def test_drawing_is_unbiased(config):
    """Size: each of 10 counts of 4 000 draws lies within 4.5 standard errors of N w: 7e-5 in all; for
    multinomial draws their total is also tested by chi-square at 1e-4, and their variance, N w (1 - w),
    within 4.5 standard errors of 3 % (heaviest particle)."""
    share, draws = np.array([0.01, 0.03, 0.05, 0.08, 0.1, 0.1, 0.12, 0.15, 0.16, 0.2]), 4000
    keys = jax.random.split(jax.random.key(3), draws)
    resampling = jax.jit(jax.vmap(partial(particles.resample, config, share)))(keys)
    counts = np.stack([np.bincount(row, minlength=10) for row in np.asarray(resampling.ancestor)])
    spread = np.sqrt(10 * share * (1 - share) / draws)
    assert (np.abs(counts.mean(axis=0) - 10 * share) <= 4.5 * spread).all()
    assert (counts.sum(axis=1) == 10).all()
    if config is MULTINOMIAL:
        assert chisquare(counts.sum(axis=0), 10 * share * draws).pvalue > 1e-4
        assert counts[:, -1].var() == pytest.approx(10 * 0.2 * 0.8, rel=4.5 * 0.03)


def test_copies_differ_a_little_and_survivors_not_at_all():
    """Size: standard deviations of 15 numbers, each of 20 000 copies, within 4.5 standard errors: 1e-4."""
    count = 20_001
    config = ResamplingConfig(length=0.01, heading=0.02, scale=0.03)
    before = swarm(np.arange(3 * count).reshape(count, 3), session=0.1)
    before = before._replace(
        move=before.session + jnp.arange(count, dtype=float)[:, None], weight=-before.pose[:, 0]
    )
    resampling = placed(np.where(np.arange(count) == 7, count, 0))
    after = jax.jit(particles.copy_particles, static_argnums=0)(config, before, resampling, jax.random.key(0))
    before, after = (jax.tree.map(np.asarray, group) for group in (before, after))
    assert np.array_equal(after.pose[7], before.pose[7])
    assert np.array_equal(after.session[7], before.session[7])
    assert np.array_equal(after.move, np.tile(before.move[7], (count, 1)))
    assert not np.any(after.weight)
    jitter = np.concatenate([after.pose - before.pose[7], after.session - before.session[7]], axis=1)
    jitter = np.delete(jitter, 7, axis=0) / [0.01, 0.01, 0.02, 0.03, 0.03]
    assert np.abs(np.cov(jitter.T) - np.eye(5)).max() < 4.5 * np.sqrt(2 / count)
