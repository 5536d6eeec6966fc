"""Laws of weights: products of likelihoods, vanished weights, weighted means."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.grid import particles
from tactile.base.se2 import wrap
from tests.ratslam.grid.particle_cases import COUNT, swarm

weighed = jax.jit(particles.weigh)
averaged = jax.jit(particles.weighted_mean)


@settings(max_examples=50)
@given(st.lists(st.floats(-1e4, 1e4), min_size=COUNT, max_size=COUNT), st.floats(-1e3, 1e3))
def test_weights_are_a_distribution_independent_of_a_common_offset(logs, shift):
    share = particles.normalised_weights(jnp.asarray(logs))
    assert float(share.sum()) == pytest.approx(1)
    assert share == pytest.approx(
        np.asarray(particles.normalised_weights(jnp.asarray(logs) + shift)), abs=1e-9
    )
    assert 1 - 1e-9 <= float(particles.effective_count(share)) <= COUNT + 1e-9


def test_likelihoods_multiply_weights():
    before = swarm(np.zeros((COUNT, 3)))
    first, second = np.random.default_rng(0).normal(0, 3, (2, COUNT))
    after, vanished = weighed(weighed(before, first)[0], second)
    expected = np.exp(first + second) / np.exp(first + second).sum()
    assert np.asarray(particles.normalised_weights(after.weight)) == pytest.approx(expected)
    assert float(after.weight.max()) == 0
    assert not vanished
    assert particles.effective_count(particles.normalised_weights(before.weight)) == pytest.approx(COUNT)


@pytest.mark.parametrize(
    "odd", [[-np.inf] * COUNT, [np.nan] * COUNT, [0.0] * 15 + [np.nan], [np.inf] * COUNT]
)
def test_vanished_weights_are_left_unchanged_and_flagged(odd):
    before = swarm(np.zeros((COUNT, 3)))._replace(weight=-jnp.arange(COUNT, dtype=float))
    after, vanished = weighed(before, jnp.asarray(odd))
    assert vanished
    assert np.array_equal(after.weight, before.weight)


def test_one_particle_that_explains_the_contacts_is_enough():
    likelihood = np.full(COUNT, -np.inf)
    likelihood[5] = -1e6
    after, vanished = weighed(swarm(np.zeros((COUNT, 3))), likelihood)
    assert not vanished
    assert np.array_equal(particles.normalised_weights(after.weight), np.arange(COUNT) == 5)


@given(st.integers(0, 2**32 - 1), st.floats(-7, 7))
def test_the_mean_turns_with_the_particles(seed, turned):
    stream = np.random.default_rng(seed)
    poses, share = stream.normal(0, [1, 1, 0.4], (COUNT, 3)), stream.dirichlet(np.ones(COUNT))
    pose, spread = averaged(poses, share)
    shifted, same = averaged(poses + [3, -2, turned], share)
    middle = share @ poses[:, :2]
    assert pose[:2] == pytest.approx(middle)
    assert spread[:2] == pytest.approx(np.sqrt(share @ (poses[:, :2] - middle) ** 2))
    assert pose[2] == pytest.approx(share @ poses[:, 2], abs=0.1)
    assert shifted[:2] - pose[:2] == pytest.approx([3, -2])
    assert wrap(float(shifted[2] - pose[2]) - turned) == pytest.approx(0, abs=1e-9)
    assert spread == pytest.approx(np.asarray(same))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_particles_that_agree_have_no_spread(dtype):
    pose, spread = averaged(np.full((COUNT, 3), 2.5, dtype), np.full(COUNT, 1 / COUNT, dtype))
    assert pose == pytest.approx([2.5, 2.5, 2.5])
    assert np.asarray(spread) == pytest.approx(0, abs=1e-3)  # square roots of rounding errors
