"""Laws of recall by whisker images, of their levels, and of their likelihood by slow sums over the pixels;
rows of the memory after keyframes were merged or restored."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.recall import whisker_likelihood as touch
from ratslam.recall.config import RecallConfig, sector_shifts
from ratslam.recall.filter import place_of
from ratslam.recall.memory import MapFeedback, MergedRows, init_memory
from ratslam.recall.observation_model import STEPS, touch_likelihood
from tactile.whisker_geometry import HeadConfig, ur10_head
from tests.helpers.merges import random_merge
from tests.ratslam.recall.recall_cases import believing, holding, recalled, spaced

CELL, SHAPE, GUARD, CAPACITY, NEW_IMAGE_LOG_ODDS = 0.05, (3, 6, 1), 5, 64, 3.0
PIXELS = touch.pixel_layout(SHAPE)
SIZE = len(PIXELS.group)
BOTH = RecallConfig(sector_fov="whiskers", guard=GUARD)
AHEAD = BOTH.model_copy(update={"shifts": 0})
SEEDS, seeds = range(8), st.integers(0, 10_000)
COUNT, PLACED = 20, ("x", "y", "heading", "cosine", "sine")
"""Rows of a memory whose keyframes are merged, and those of its arrays that hold their poses."""


def images_of(stream, count, touching=0.4, dead=0.0):
    """[count, D] levels."""
    level = stream.integers(1, touch.DEAD, (count, SIZE)) * (stream.random((count, SIZE)) < touching)
    return np.where(stream.random((count, SIZE)) < dead, touch.DEAD, level)


def learn(images):
    """The log-odds table learned from these images."""
    return touch.log_odds_table(touch.estimate_background(images, PIXELS.group), touch.PRIOR)


def filled(config, images, poses, likeness, scale=NEW_IMAGE_LOG_ODDS):
    """A memory of frames [N, D] at poses [N, 3]; the robot is at the newest."""
    memory = init_memory(config, SIZE, CAPACITY, np.dtype(float), len(likeness))
    view = jnp.asarray(np.pad(images.T, ((0, 0), (0, CAPACITY - len(poses)))), jnp.int32)
    memory = memory._replace(view=view, count=jnp.int32(len(poses)))
    return memory.apply_map_feedback(MapFeedback(poses, 0.0, 0.0, 0.0, np.pi, scale, likeness))


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


@partial(jax.jit, static_argnums=0)
def likelihoods(config, memory, level):
    return touch_likelihood(config, memory, level, PIXELS)


@partial(jax.jit, static_argnums=0)
def recognised(config, memory, belief, level):
    memory, weighing = touch_likelihood(config, memory, level, PIXELS)
    return memory, *recalled(config, memory, belief, weighing, CELL)


def weigh(config, memory, level):
    return jax.tree.map(np.asarray, likelihoods(config, memory, jnp.asarray(level, jnp.int32)))


def observe(config, memory, level, belief=None):
    """The memory and the belief after an image, and the result; without a belief all is novelty."""
    belief = holding(config, memory, cell=CELL) if belief is None else belief
    return jax.tree.map(np.asarray, recognised(config, memory, belief, jnp.asarray(level, jnp.int32)))


@settings(max_examples=30)
@given(seeds, st.sampled_from([BOTH, AHEAD]), st.sampled_from([None, "other", 0, touch.DEAD, touch.HEIGHTS]))
def test_mass_is_conserved(seed, config, level):
    """Of a known image, of another, and of all whiskers silent, dead or bent fully."""
    memory, belief, known = random_case(seed, config)
    other = images_of(np.random.default_rng(seed + 1), 1)[0]
    level = known if level is None else other if level == "other" else np.full(SIZE, level)
    _, after, found = observe(config, memory, level, belief)
    assert (after.activity >= 0).all()
    assert after.activity.sum() + found.novelty == pytest.approx(1, abs=1e-5)
    assert 0 <= found.posterior <= 1 + 1e-5
    assert 0 <= found.second <= 1 - found.posterior + 1e-5


@pytest.mark.parametrize("config", [BOTH, AHEAD])
def test_nothing_is_recognised_without_frames_or_log_odds_or_by_dead_whiskers(config):
    images = images_of(np.random.default_rng(0), 40)
    learnt = learn(images)
    empty = filled(config, images[:GUARD], spaced(GUARD, cell=CELL), learnt)
    untaught = filled(config, images, spaced(40, cell=CELL), np.zeros(learnt.shape), scale=0.0)
    for memory in (empty, untaught):
        after, found = weigh(config, memory, images[7])
        assert not found.certain
        assert not found.informative
        assert (found.likelihood == 1).all()
        assert found.novelty == 1
        assert not after.before.any()
        _, _, one = observe(config, memory, images[7])
        assert (one.match, one.log_ratio, one.posterior, one.novelty, one.view_fits) == (-1, 0, 0, 1, -1)
    taught = filled(config, images, spaced(40, cell=CELL), learnt)
    assert observe(config, taught, images[7])[-1].match == 7
    memory, *_ = random_case(1)
    found = weigh(BOTH, memory, np.full(SIZE, touch.DEAD))[1]
    assert (found.likelihood[:, : int(memory.count) - GUARD] == 1).all()
    assert found.novelty >= 1


def test_only_whiskers_have_arrays_for_their_history():
    for config, rows in ((BOTH, 2), (AHEAD, 1)):
        memory = init_memory(config, SIZE, CAPACITY, np.dtype(float), 3)
        assert memory.before.shape == (rows, CAPACITY)
        assert memory.likeness.shape == (3, touch.LEVELS, touch.LEVELS)
        assert memory.view.dtype == np.int32
    for fan in ("auto", "none", 1.0):
        memory = init_memory(RecallConfig(sector_fov=fan), SIZE, CAPACITY, np.dtype(float))
        assert memory.before.size == memory.likeness.size == 0


@pytest.mark.parametrize("turned", [False, True])
def test_a_head_turned_by_half_a_turn_is_recognised_with_its_heading(turned):
    images = images_of(np.random.default_rng(0), 40)
    memory = filled(BOTH, images, spaced(40, cell=CELL), learn(images))
    for place in (0, 11, 34):
        now = images[place][PIXELS.opposite] if turned else images[place]
        _, after, found = observe(BOTH, memory, now)
        assert found.match == place
        assert found.shift == turned
        assert np.unravel_index(after.mass.argmax(), after.mass.shape) == (turned, place)
        heading = place_of(memory, jax.tree.map(jnp.asarray, found))[2]
        assert math.cos(float(heading)) == pytest.approx(-1 if turned else 1, abs=1e-6)
        alone = observe(AHEAD, filled(AHEAD, images, spaced(40, cell=CELL), learn(images)), now)[-1]
        assert alone.shift == 0
        assert (alone.match == place and alone.log_ratio > 0) != turned


def likelihood_by_loops(config, memory, level):
    """Likelihoods [S, C] and the likelihood of novelty, pixel by pixel."""
    m = jax.tree.map(np.asarray, memory)
    old = range(int(m.count) - config.guard)
    turned = len(m.before) > 1
    likelihood = np.zeros(m.before.shape)
    for c in old:
        for s in range(1 + turned):
            then = [m.view[PIXELS.opposite[d] if s else d, c] for d in range(SIZE)]
            odds = sum(m.likeness[PIXELS.group[d], level[d], then[d]] for d in range(SIZE))
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
        same = jax.tree.map(np.array_equal, after._replace(before=memory.before), memory)
        assert all(jax.tree.leaves(same))


share = st.floats(0.001, 0.999)
visits = st.builds(touch.Variation, share, share, st.floats(0.005, 1.0), share)


@given(st.tuples(st.integers(1, 4), st.integers(1, 9), st.integers(1, 3)))
def test_pixels_of_a_ring_and_channel_are_one_group(shape):
    known = touch.pixel_layout(shape)
    group = known.group.reshape(shape)
    assert (group == group[:, :1]).all()
    assert np.unique(group).tolist() == list(range(shape[0] * shape[2]))
    assert np.array_equal(np.sort(known.opposite), np.arange(group.size))
    assert np.array_equal(known.group[known.opposite], known.group)


@pytest.mark.parametrize("columns", [2, 4, 6, 8])
def test_the_opposite_pixel_is_that_of_the_opposite_whisker(columns):
    head = ur10_head(HeadConfig(whiskers=columns, first_deg=17.0))
    behind = touch.pixel_layout((*head.shape, 1)).opposite
    assert np.allclose(head.rest[behind, :2], -head.rest[:, :2], atol=1e-12)
    assert np.allclose(head.base[behind, 2], head.base[:, 2])


@given(st.lists(st.floats(-1, 2), min_size=1, max_size=20), seeds)
def test_levels_are_thirtieths_rounded_up_and_negative_values_are_silent(values, seed):
    view, alive = np.array(values), np.random.default_rng(seed).random(len(values)) < 0.7
    expected = [min(max(math.ceil(value * 30), 0), 30) for value in values]
    assert touch.pixel_levels(view, alive).tolist() == np.where(alive, expected, 31).tolist()
    assert (touch.HEIGHTS, touch.DEAD, touch.LEVELS) == (30, 31, 32)


@given(seeds)
def test_levels_are_the_same_on_the_host_and_in_the_kernel(seed):
    stream = np.random.default_rng(seed)
    view, alive = stream.random(SIZE) * (stream.random(SIZE) < 0.5), stream.random(SIZE) < 0.8
    levels = touch.pixel_levels(jnp.asarray(view), jnp.asarray(alive, float))
    assert np.array_equal(touch.pixel_levels(view, alive), np.asarray(levels))
    single = touch.pixel_levels(jnp.asarray(view, jnp.float32), jnp.asarray(alive, jnp.float32))
    assert single.dtype == jnp.float32
    assert np.abs(np.asarray(single) - np.asarray(levels)).max() <= 1  # rounding, at a border between levels


@given(seeds, st.integers(0, 20), st.floats(0, 1), st.floats(0, 1))
def test_the_background_counts_by_ring_and_channel_what_is_not_dead(seed, count, touching, dead):
    """As if there had been four more pixels, one of them in contact, and one more of each height."""
    level = images_of(np.random.default_rng(seed), count, touching, dead)
    found = touch.estimate_background(level, PIXELS.group)
    for group in range(3):
        silent, *heights = np.bincount(level[:, group == PIXELS.group].ravel(), minlength=32)[:31]
        assert found[0][group] == pytest.approx((sum(heights) + 1) / (silent + sum(heights) + 4))
        assert found[1][group] == pytest.approx((np.array(heights) + 1) / (sum(heights) + 30))


def variation_by_loops(now, then):
    """Shares and heights of the pixels of pairs, and of a prior of twenty half pairs; an outlier may have any
    height, others differ by an exponential distribution."""
    alive, weight = (now != touch.DEAD) & (then != touch.DEAD), 20 * now.shape[1] / 2
    silent, touching = now[alive & (then == 0)], now[alive & (then > 0)]
    appears = ((silent > 0).sum() + weight * touch.PRIOR.appears) / (len(silent) + weight)
    vanishes = ((touching == 0).sum() + weight * touch.PRIOR.vanishes) / (len(touching) + weight)
    apart = np.abs(now - then)[alive & (now > 0) & (then > 0)] / 30
    width, outliers = touch.PRIOR.width, touch.PRIOR.outliers
    for _ in range(20):
        loose = outliers / (outliers + (1 - outliers) * np.exp(-apart / width) / (2 * width))
        outliers = (loose.sum() + weight * touch.PRIOR.outliers) / (len(apart) + weight)
        width = ((1 - loose) @ apart + weight * touch.PRIOR.width) / (len(apart) - loose.sum() + weight)
    return touch.Variation(appears, vanishes, width, outliers)


@given(seeds, st.integers(0, 40), st.floats(0, 1))
def test_the_variation_is_estimated_from_pairs_and_a_prior(seed, count, dead):
    stream = np.random.default_rng(seed)
    then, other = images_of(stream, count, dead=dead), images_of(stream, count, dead=0.1)
    near = np.clip(then + stream.integers(-2, 3, then.shape), 1, touch.HEIGHTS)
    now = np.where(stream.random(then.shape) < 0.7, near, other)
    assert touch.estimate_variation(now, then) == pytest.approx(variation_by_loops(now, then), rel=1e-9)
    assert touch.estimate_variation(then[:0], then[:0]) == pytest.approx(touch.PRIOR, rel=1e-12)


@given(seeds, visits)
def test_odds_follow_from_one_distribution(seed, visits):
    """Given an earlier level, probabilities of the levels at the same place sum to 1; a dead pixel carries no
    evidence."""
    stream = np.random.default_rng(seed)
    touching, heights = stream.uniform(0.02, 0.98, 3), stream.dirichlet(np.full(touch.HEIGHTS, 0.5), 3) + 1e-9
    heights = heights / heights.sum(axis=1, keepdims=True)
    log = touch.log_odds_table((touching, heights), visits)
    assert log.shape == (3, touch.LEVELS, touch.LEVELS)
    assert not log[:, touch.DEAD].any()
    assert not log[:, :, touch.DEAD].any()
    near = np.exp(-np.abs(np.arange(30)[:, None] - np.arange(30)) / 30 / visits.width)
    near = near / near.sum(axis=0)
    for group in range(3):
        background = np.concatenate([[1 - touching[group]], touching[group] * heights[group]])
        again = background[:, None] * np.exp(log[group, : touch.DEAD, : touch.DEAD])
        assert np.allclose(again.sum(axis=0), 1, rtol=1e-9)
        assert again[0, 0] == pytest.approx(1 - visits.appears)
        assert again[0, 1:] == pytest.approx(np.full(30, visits.vanishes))
        mixed = (1 - visits.outliers) * near + visits.outliers * heights[group][:, None]
        assert np.allclose(again[1:, 1:], (1 - visits.vanishes) * mixed, rtol=1e-6)
        assert np.allclose(again[1:, 0], visits.appears * heights[group], rtol=1e-6)


def random_memory(stream, config, dtype=np.float64, count=COUNT):
    """A memory with all of its values random."""
    empty = init_memory(config, SIZE, CAPACITY, np.dtype(dtype), groups=2)
    filled = jax.tree.map(lambda x: stream.uniform(0, 1, x.shape).astype(x.dtype), empty)
    rows = np.arange(CAPACITY) < count
    return filled._replace(
        count=np.int32(count), distinct=np.int32(7),
        view=stream.integers(1, 5, empty.view.shape).astype(empty.view.dtype) * rows,
        label=np.where(rows, stream.integers(0, 50, CAPACITY), -1).astype(np.int32),
    )  # fmt: skip


def merge_with_views(stream):
    merged = random_merge(stream, COUNT)
    count = len(merged.source)
    return merged._replace(view=stream.integers(1, 5, (count, SIZE)), label=stream.integers(0, 50, count))


@pytest.mark.parametrize("config", [BOTH, RecallConfig(sector_fov="auto")])
@pytest.mark.parametrize("seed", range(3))
def test_rows_are_those_that_remain(seed, config):
    stream = np.random.default_rng(seed)
    memory, merged = random_memory(stream, config), merge_with_views(stream)
    after, rows = memory.merge_rows(merged), len(merged.source)
    source = np.append(merged.source, np.full(CAPACITY - rows, COUNT))  # rows from there on are empty
    expected = {name: getattr(memory, name)[source] * (source < COUNT) for name in PLACED}
    expected |= {"count": rows, "view": np.pad(merged.view.T, ((0, 0), (0, CAPACITY - rows)))}
    expected["label"] = np.append(merged.label, np.full(CAPACITY - rows, -1))
    expected["before"] = memory.before[..., source] * (source < COUNT) if config is BOTH else memory.before
    for name, was in memory._asdict().items():
        assert np.array_equal(getattr(after, name), expected.get(name, was)), name


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes_and_dtypes_stay(dtype):
    stream = np.random.default_rng(0)
    memory, merged = random_memory(stream, BOTH, dtype), merge_with_views(stream)
    after = memory.merge_rows(merged)
    one, other = (jax.tree.map(lambda x: (np.shape(x), x.dtype), each) for each in (after, memory))
    assert one == other
    leaves = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(after) if isinstance(leaf, jax.Array)]
    assert len(set(leaves)) == len(leaves)  # one buffer each, because the session donates them


def test_merged_keyframes_can_be_restored_but_no_more_than_the_memory_holds():
    """Twice as many rows: each former one comes back beside the one that it was merged with."""
    stream, source = np.random.default_rng(0), np.repeat(np.arange(10), 2)
    memory, views = random_memory(stream, BOTH, count=10), (stream.integers(1, 5, (20, SIZE)), np.arange(20))
    after = memory.merge_rows(MergedRows(source, 2 * np.arange(10), np.zeros((10, 3)), *views))
    assert int(after.count) == 20
    assert np.array_equal(np.asarray(after.x)[:20], memory.x[source])
    memory = random_memory(stream, BOTH)

    def rows(count):
        source = np.minimum(np.arange(count), COUNT - 1)
        views = np.ones((count, SIZE), int), np.zeros(count, int)
        return MergedRows(source, np.arange(COUNT), np.zeros((COUNT, 3)), *views)

    assert int(memory.merge_rows(rows(CAPACITY)).count) == CAPACITY
    with pytest.raises(ValueError, match=f"{CAPACITY + 1} keyframes do not fit into a memory of {CAPACITY}"):
        memory.merge_rows(rows(CAPACITY + 1))
