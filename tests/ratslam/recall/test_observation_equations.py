"""The observation model equals explicit loops over its equations."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.recall.config import sector_shifts
from ratslam.recall.filter import FOLLOWERS, SUPPORT, follow_keyframes
from ratslam.recall.observation_model import STEPS
from tactile.base.se2 import between, compose
from tests.ratslam.recall.whisker_cases import (
    AHEAD,
    BOTH,
    CAPACITY,
    CELL,
    GUARD,
    PIXELS,
    SEEDS,
    SIZE,
    host,
    random_case,
    weigh,
)

# The loops


def likelihood_by_loops(config, memory, level):
    """Likelihoods [S, C] and the likelihood of novelty, pixel by pixel."""
    m = host(memory)
    old = range(int(m.count) - config.guard)
    turned = len(m.before) > 1
    likelihood = np.zeros(m.before.shape)
    for c in old:
        for s in range(1 + turned):
            odds = 0.0
            for d in range(SIZE):
                then = m.view[PIXELS.opposite[d] if s else d, c]
                odds += m.likeness[PIXELS.group[d], level[d], then]
            likelihood[s, c] = math.exp(config.temper * odds)
    weight, familiar = 0.0, 0.0
    for s in range(1 + turned):
        for c in range(CAPACITY):
            for step, share in enumerate(STEPS):
                to = c - step if s else c + step
                if to in old:
                    weight += m.before[s, c] * share
                    familiar += m.before[s, c] * share * likelihood[s, to]
    unlike = math.exp(config.temper * m.scale)
    if not weight:
        return likelihood, unlike
    return likelihood, config.familiar * familiar / weight + (1 - config.familiar) * unlike


def transition_by_loops(config, m):
    """The prior mass from outside the modes, frame by frame, and the mass that becomes novelty."""
    heading = np.arctan2(m.sine, m.cosine)
    belief, novel = np.zeros(m.rest.shape), 0.0
    old = range(int(m.count) - config.guard)
    for s in range(len(m.rest)):
        for c in range(CAPACITY):
            robot = compose(np.array([m.x[c], m.y[c], heading[c] - s * np.pi]), m.motion)
            falls = {}
            for step in range(FOLLOWERS):
                to = c - step if s else c + step
                if to not in old:
                    continue
                apart = between(np.array([m.x[to], m.y[to], heading[to] - s * np.pi]), robot)
                deviation = (apart[0] ** 2 + apart[1] ** 2) / (config.reach * CELL) ** 2
                deviation += 2 * (1 - math.cos(apart[2])) / config.reach_heading**2
                falls[to] = max(1 - deviation / SUPPORT, 0) ** 4
            total = sum(falls.values()) + config.miss_weight
            stay = m.rest[s, c] * (1 - config.mode_decay)
            for to, fall in falls.items():
                belief[s, to] += stay * fall / total
            novel += m.rest[s, c] * config.mode_decay + stay * config.miss_weight / total
    return belief, novel


@pytest.mark.parametrize("config", [BOTH, AHEAD], ids=["both ways", "ahead only"])
@pytest.mark.parametrize("seed", SEEDS)
def test_likelihoods_equal_explicit_loops(config, seed):
    memory, level = random_case(seed, config)
    likelihood, novelty = likelihood_by_loops(config, memory, level)
    after, found = weigh(config, memory, level)
    assert np.allclose(found.likelihood, likelihood, rtol=1e-9)
    assert float(found.novelty) == pytest.approx(novelty, rel=1e-9)
    assert np.array_equal(after.before, found.likelihood)
    assert found.certain == found.informative == (int(memory.count) > GUARD)
    assert np.isnan(found.background).all()
    same = jax.tree.map(np.array_equal, after._replace(before=memory.before), host(memory))
    assert all(jax.tree.leaves(same))


@pytest.mark.parametrize("config", [BOTH, AHEAD], ids=["both ways", "ahead only"])
@pytest.mark.parametrize("seed", SEEDS)
def test_mass_outside_the_modes_follows_the_frames(config, seed):
    memory, _ = random_case(seed, config)
    m = host(memory)
    shifts = sector_shifts(config)
    cells = np.ones((len(shifts), 1)) * (np.arange(CAPACITY) < int(m.count) - GUARD)
    angles = jnp.asarray(-shifts * np.pi)
    belief, novel = follow_keyframes(config, CELL, memory, angles, jnp.asarray(cells), memory.motion)
    expected, lost = transition_by_loops(config, m)
    assert np.allclose(belief, expected, atol=1e-12)
    assert float(novel) == pytest.approx(lost, abs=1e-12)
    assert float(belief.sum() + novel) == pytest.approx(float(m.rest.sum()), abs=1e-12)


def test_the_seeds_cover_turned_matches_and_mass_outside_the_modes():
    shares = []
    for seed in SEEDS:
        memory, _ = random_case(seed)
        belief, novel = transition_by_loops(BOTH, host(memory))
        shares.append([*belief.sum(axis=1), novel])
    assert (np.array(shares).max(axis=0) > 0.05).all()
