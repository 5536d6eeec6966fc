"""Laws of recall by whisker images."""

from __future__ import annotations

import math
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.filter import place_of, recognise
from ratslam.recall.memory import MapFeedback, init_memory
from ratslam.recall.observation_model import STEPS, touch_likelihood
from ratslam.recall.whisker_likelihood import (
    DEAD,
    HEIGHTS,
    LEVELS,
    PRIOR,
    estimate_background,
    log_odds_table,
    pixel_layout,
)
from tests.ratslam.recall.recall_cases import believing, holding, network_of

CELL = 0.05
SHAPE = (3, 6, 1)
PIXELS = pixel_layout(SHAPE)
SIZE = len(PIXELS.group)
GUARD = 5
CAPACITY = 64
NEW_IMAGE_LOG_ODDS = 3.0
BOTH = RecallConfig(sector_fov="whiskers", guard=GUARD)
AHEAD = BOTH.model_copy(update={"shifts": 0})
SEEDS = range(8)


def images_of(stream, count, touching=0.4, dead=0.0):
    """[count, D] levels."""
    level = stream.integers(1, DEAD, (count, SIZE)) * (stream.random((count, SIZE)) < touching)
    return np.where(stream.random((count, SIZE)) < dead, DEAD, level)


def learn(images):
    """The log-odds table learned from these images."""
    return log_odds_table(estimate_background(images, PIXELS.group), PRIOR)


def filled(config, images, poses, likeness, *, scale=NEW_IMAGE_LOG_ODDS, dtype=float):
    """A memory of frames [N, D] at poses [N, 3]; the robot is at the newest."""
    count = len(poses)
    memory = init_memory(config, SIZE, CAPACITY, np.dtype(dtype), len(likeness))
    store = np.zeros((SIZE, CAPACITY), np.int32)
    store[:, :count] = images.T
    memory = memory._replace(view=jnp.asarray(store), count=jnp.int32(count))
    return memory.apply_map_feedback(MapFeedback(poses, 0.0, 0.0, 0.0, np.pi, scale, likeness))


def spaced(count, cells=4.0):
    """Poses in a row so far apart that no frame is near another."""
    return np.stack([np.arange(count) * cells * CELL, np.zeros(count), np.zeros(count)], axis=1)


def random_case(seed, config=BOTH):
    """A memory in the middle of a path that doubles back, with all arrays filled, its belief, and a
    half-known image."""
    stream = np.random.default_rng(seed)
    count = int(stream.integers(GUARD + 2, CAPACITY + 1))
    poses = np.cumsum(stream.normal(0, 0.5 * CELL, (count, 3)), axis=0)
    poses[:, 2] = stream.normal(0, 0.3, count) + np.pi * stream.integers(0, 2, count)
    images = images_of(stream, count, dead=0.05)
    memory = filled(config, images, poses, learn(images))
    old = max(count - GUARD, 0)
    rows = len(sector_shifts(config))
    before, mass = np.zeros((2, rows, CAPACITY))
    before[:, :old] = stream.exponential(1, (rows, old))
    before[:, CAPACITY // 3] = 0.0
    mass[:, :old] = stream.dirichlet(np.full(rows * old + 1, 0.3))[:-1].reshape(rows, old)
    memory = memory._replace(before=jnp.asarray(before))
    belief = believing(config, memory, mass, CELL)
    memory = memory.accumulate_motion(jnp.asarray(stream.normal(0, [CELL, 0.2 * CELL, 0.1])))
    near = images[stream.integers(0, max(old, 1))]
    return memory, belief, np.where(stream.random(SIZE) < 0.7, near, images_of(stream, 1)[0])


@cache
def compile_likelihood(config):
    return jax.jit(lambda memory, level: touch_likelihood(config, memory, level, PIXELS))


@cache
def filter_of(config):
    network = network_of(config, CELL)

    def observe(memory, belief, level):
        memory, weighing = touch_likelihood(config, memory, level, PIXELS)
        motion = memory.corrected_motion()
        return memory, *recognise(config, network, memory, belief, motion, weighing, config.local)

    return jax.jit(observe)


def host(tree):
    return jax.tree.map(np.asarray, tree)


def weigh(config, memory, level):
    return host(compile_likelihood(config)(memory, jnp.asarray(level, jnp.int32)))


def observe(config, memory, level, belief=None):
    """The memory and the belief after an image, and the result; without a belief all is novelty."""
    belief = holding(config, memory, cell=CELL) if belief is None else belief
    return host(filter_of(config)(memory, belief, jnp.asarray(level, jnp.int32)))


seeds = st.integers(0, 10_000)

# The posterior is a distribution


@settings(max_examples=30)
@given(seeds, st.sampled_from([BOTH, AHEAD]), st.sampled_from(["known", "other", "silent", "dead", "full"]))
def test_mass_is_conserved(seed, config, kind):
    memory, belief, level = random_case(seed, config)
    level = {
        "known": level,
        "other": images_of(np.random.default_rng(seed + 1), 1)[0],
        "silent": np.zeros(SIZE, int),
        "dead": np.full(SIZE, DEAD),
        "full": np.full(SIZE, HEIGHTS),
    }[kind]
    _, after, found = observe(config, memory, level, belief)
    assert (after.activity >= 0).all()
    assert after.activity.sum() + found.novelty == pytest.approx(1, abs=1e-5)
    assert 0 <= found.posterior <= 1 + 1e-5
    assert 0 <= found.second <= 1 - found.posterior + 1e-5


# Images without evidence


def test_a_head_of_dead_whiskers_recognises_no_place():
    memory, *_ = random_case(1)
    found = weigh(BOTH, memory, np.full(SIZE, DEAD))[1]
    assert (found.likelihood[:, : int(memory.count) - GUARD] == 1).all()
    assert found.novelty >= 1


@pytest.mark.parametrize("config", [BOTH, AHEAD])
def test_nothing_is_recognised_without_frames_or_log_odds(config):
    images = images_of(np.random.default_rng(0), 40)
    learnt = learn(images)
    empty = filled(config, images[:GUARD], spaced(GUARD), learnt)
    untaught = filled(config, images, spaced(40), np.zeros(learnt.shape), scale=0.0)
    for memory in (empty, untaught):
        after, found = weigh(config, memory, images[7])
        assert not found.certain
        assert not found.informative
        assert (found.likelihood == 1).all()
        assert found.novelty == 1
        assert not after.before.any()
        _, _, one = observe(config, memory, images[7])
        assert (one.match, one.log_ratio, one.posterior, one.novelty, one.view_fits) == (-1, 0, 0, 1, -1)
    taught = filled(config, images, spaced(40), learnt)
    assert observe(config, taught, images[7])[-1].match == 7


def test_only_whiskers_have_arrays_for_their_history():
    for config, rows in ((BOTH, 2), (AHEAD, 1)):
        memory = init_memory(config, SIZE, CAPACITY, np.dtype(float), 3)
        assert memory.before.shape == (rows, CAPACITY)
        assert memory.likeness.shape == (3, LEVELS, LEVELS)
        assert memory.view.dtype == np.int32
    for fan in ("auto", "none", 1.0):
        memory = init_memory(RecallConfig(sector_fov=fan), SIZE, CAPACITY, np.dtype(float))
        assert memory.before.size == memory.likeness.size == 0


# Recognition


@pytest.mark.parametrize("turned", [False, True])
def test_a_head_turned_by_half_a_turn_is_recognised_with_its_heading(turned):
    images = images_of(np.random.default_rng(0), 40)
    memory = filled(BOTH, images, spaced(40), learn(images))
    for place in (0, 11, 34):
        now = images[place][PIXELS.opposite] if turned else images[place]
        _, after, found = observe(BOTH, memory, now)
        assert found.match == place
        assert found.shift == turned
        assert np.unravel_index(after.mass.argmax(), after.mass.shape) == (turned, place)
        heading = place_of(memory, jax.tree.map(jnp.asarray, found))[2]
        assert math.cos(float(heading)) == pytest.approx(-1 if turned else 1, abs=1e-6)
        alone = observe(AHEAD, filled(AHEAD, images, spaced(40), learn(images)), now)[-1]
        assert alone.shift == 0
        assert (alone.match == place and alone.log_ratio > 0) != turned


# Explicit loops over the equations


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


@pytest.mark.parametrize("config", [BOTH, AHEAD], ids=["both ways", "ahead only"])
def test_likelihoods_equal_explicit_loops(config):
    for seed in SEEDS:
        memory, _, level = random_case(seed, config)
        likelihood, novelty = likelihood_by_loops(config, memory, level)
        after, found = weigh(config, memory, level)
        assert np.allclose(found.likelihood, likelihood, rtol=1e-9)
        assert float(found.novelty) == pytest.approx(novelty, rel=1e-9)
        assert np.array_equal(after.before, found.likelihood)
        assert found.certain == found.informative == (int(memory.count) > GUARD)
        assert np.isnan(found.background).all()
        same = jax.tree.map(np.array_equal, after._replace(before=memory.before), host(memory))
        assert all(jax.tree.leaves(same))
