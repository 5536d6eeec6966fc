"""Laws of recall by whisker images."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.recall.config import RecallConfig
from ratslam.recall.filter import place_of
from ratslam.recall.memory import MapFeedback, init_memory
from ratslam.recall.observation_model import STEPS
from ratslam.recall.whisker_likelihood import DEAD, HEIGHTS, LEVELS, pixel_levels
from tests.ratslam.recall.recall_cases import believing
from tests.ratslam.recall.whisker_cases import (
    AHEAD,
    BOTH,
    CAPACITY,
    CELL,
    GUARD,
    NEW_IMAGE_LOG_ODDS,
    PIXELS,
    SEEDS,
    SIZE,
    filled,
    host,
    images_of,
    learn,
    observe,
    random_case,
    spaced,
    weigh,
)

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


@pytest.mark.parametrize(
    ("config", "dtype"),
    [(BOTH, float), (AHEAD, float), pytest.param(BOTH, np.float32, marks=pytest.mark.soak)],
)
def test_mass_is_conserved_along_a_path(config, dtype):
    """A lap driven three times, every image remembered, from the first one on."""
    stream = np.random.default_rng(0)
    lap = images_of(stream, 20)
    turn = 2 * np.pi / 20
    likeness = learn(images_of(stream, 200))
    memory = init_memory(config, SIZE, CAPACITY, np.dtype(dtype), len(likeness))
    memory = memory.apply_map_feedback(
        MapFeedback(np.zeros((1, 3)), 0.0, 0.0, 0.0, np.pi, NEW_IMAGE_LOG_ODDS, likeness)
    )
    again, belief = [], None
    for k in range(60):
        level = np.where(stream.random(SIZE) < 0.9, lap[k % 20], images_of(stream, 1)[0])
        memory = memory.accumulate_motion(jnp.asarray([0.6 * CELL, 0.0, turn], memory.x.dtype))
        memory, belief, found = observe(config, memory, level, belief)
        assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves((memory, belief, found[:-1])))
        assert {leaf.dtype for leaf in jax.tree.leaves((memory, found))} == {
            np.dtype(dtype),
            np.dtype(np.int32),
        }
        assert belief.activity.sum() + found.novelty == pytest.approx(1, abs=1e-5)
        again.append(found.match >= 0 and (k - found.match) % 20 == 0 and found.posterior > 0.1)
        memory = jax.tree.map(jnp.asarray, memory)
        memory = memory.store_keyframe(jnp.asarray(level, jnp.int32), jnp.int32(-1))
    assert not any(again[:20])
    assert np.mean(again[20:]) > 0.9  # recognised from the second lap on


# Images without evidence


@pytest.mark.parametrize("seed", SEEDS)
def test_the_pixel_of_a_dead_whisker_has_no_effect(seed):
    memory, *_ = random_case(seed)
    stream = np.random.default_rng(seed)
    view, alive = stream.random(SIZE), stream.random(SIZE) < 0.7
    other = np.where(alive, view, stream.random(SIZE))
    first, second = (weigh(BOTH, memory, pixel_levels(seen, alive).astype(int)) for seen in (view, other))
    for one, two in zip(first[1], second[1], strict=True):
        assert np.array_equal(one, two, equal_nan=True)
    # The result is that of a head without this whisker.
    without = memory._replace(likeness=jnp.asarray(np.zeros(memory.likeness.shape)))
    odds = np.log(first[1].likelihood[:, : int(memory.count) - GUARD])
    for d in np.flatnonzero(alive).tolist():
        only = np.full(SIZE, DEAD)
        only[d] = pixel_levels(view, alive).astype(int)[d]
        odds = odds - np.log(weigh(BOTH, memory, only)[1].likelihood[:, : int(memory.count) - GUARD])
    assert np.allclose(odds, 0, atol=1e-9)
    blank = weigh(BOTH, without, pixel_levels(view, alive).astype(int))[1].likelihood
    assert (blank[:, : int(memory.count) - GUARD] == 1).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_whisker_dead_in_memory_carries_no_evidence(seed):
    memory, _, level = random_case(seed)
    stream = np.random.default_rng(seed)
    gone = stream.choice(SIZE, 4, replace=False)
    gone = np.union1d(gone, PIXELS.opposite[gone])  # after half a turn these measure the same
    view = np.asarray(memory.view).copy()
    view[gone] = DEAD
    then = memory._replace(view=jnp.asarray(view))
    other = level.copy()
    other[gone] = images_of(stream, 1)[0][gone]
    first, second = weigh(BOTH, then, level)[1], weigh(BOTH, then, other)[1]
    assert np.array_equal(first.likelihood, second.likelihood)
    silenced = level.copy()
    silenced[gone] = DEAD
    assert np.allclose(weigh(BOTH, memory, silenced)[1].likelihood, first.likelihood, rtol=1e-12)


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


@pytest.mark.parametrize("turned", [False, True])
def test_a_packet_follows_the_frames_in_the_direction_of_the_head(turned):
    """To the next frame or, after half a turn, to the one before; of dead whiskers, so that only motion
    moves it."""
    images = np.full((40, SIZE), DEAD)
    memory = filled(BOTH, images, spaced(40, 1.0), learn(images_of(np.random.default_rng(0), 40)))
    mass = np.zeros((2, CAPACITY))
    mass[int(turned), 20] = 0.5
    belief = believing(BOTH, memory, mass, CELL)
    memory = memory.accumulate_motion(jnp.asarray([CELL, 0.0, 0.0]))
    _, after, _ = observe(BOTH, memory, images[0], belief)
    assert np.unravel_index(after.mass.argmax(), after.mass.shape) == (int(turned), 19 if turned else 21)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_row_of_a_frame_does_not_affect_its_likelihood(seed):
    memory, _, level = random_case(seed)
    old = int(memory.count) - GUARD
    order = np.arange(CAPACITY)
    order[:old] = np.random.default_rng(seed).permutation(old)
    shuffled = memory._replace(view=memory.view[:, order])
    first, second = weigh(BOTH, memory, level)[1], weigh(BOTH, shuffled, level)[1]
    assert np.allclose(first.likelihood[:, order], second.likelihood, rtol=1e-12)


def test_a_uniform_corridor_carries_no_evidence():
    stream = np.random.default_rng(0)
    wall, others = images_of(stream, 1)[0], images_of(stream, 200)
    memory = filled(AHEAD, np.tile(wall, (50, 1)), spaced(50, 0.6), learn(others))
    first, _, gain = observe(AHEAD, memory, wall)
    assert gain.log_ratio > 0  # the first image matches
    _, then = weigh(AHEAD, jax.tree.map(jnp.asarray, first), wall)
    assert np.log(then.likelihood.max() / then.novelty) < -math.log(AHEAD.familiar)


def test_an_image_after_several_similar_frames_carries_less_evidence():
    """Of two equal matches of the previous image, one or both are followed by the present image."""
    stream = np.random.default_rng(0)
    images = images_of(stream, 50)
    likeness = learn(images_of(stream, 200))
    gains = []
    for copies in (1, 4, 16):
        places = np.arange(2, 2 + 2 * copies, 2)
        alike = images.copy()
        alike[places], alike[places + 1] = images[2], images[3]
        memory = filled(AHEAD, alike, spaced(50), likeness)
        after, _ = weigh(AHEAD, memory, images[2])
        one = weigh(AHEAD, jax.tree.map(jnp.asarray, after), images[3])[1]
        alike[places[1:] + 1] = images[30]
        memory = filled(AHEAD, alike, spaced(50), likeness)
        after, _ = weigh(AHEAD, memory, images[2])
        other = weigh(AHEAD, jax.tree.map(jnp.asarray, after), images[3])[1]
        gains.append([float(np.log(w.likelihood[0, 3] / w.novelty)) for w in (one, other)])
    shared, alone = np.array(gains).T
    assert shared[0] == alone[0]
    assert np.allclose(shared, shared[0], atol=0.2)
    assert alone[0] < alone[1] < alone[2]


def test_the_heights_of_the_sensor_enter_by_the_table_alone():
    """Other numbers for the same levels, in memory, image and table, change nothing."""
    memory, belief, level = random_case(3)
    order = np.concatenate([[0], 1 + np.random.default_rng(0).permutation(HEIGHTS), [DEAD]])
    likeness = np.zeros(memory.likeness.shape)
    likeness[:, order[:, None], order] = np.asarray(memory.likeness)
    renamed = memory._replace(
        view=jnp.asarray(order[np.asarray(memory.view)], jnp.int32), likeness=jnp.asarray(likeness)
    )
    first, second = observe(BOTH, memory, level, belief), observe(BOTH, renamed, order[level], belief)
    for name in ("match", "shift", "posterior", "log_ratio", "novelty"):
        assert getattr(first[-1], name) == getattr(second[-1], name), name


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
@pytest.mark.parametrize("seed", SEEDS)
def test_likelihoods_equal_explicit_loops(config, seed):
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
