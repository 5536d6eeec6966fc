"""Rows of the recall memory after keyframes were merged or restored."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from ratslam.recall.config import RecallConfig
from ratslam.recall.memory import MergedRows, Modes, init_memory, merge_rows
from tactile.base.se2 import compose, wrap

TOUCH = RecallConfig(sector_fov="whiskers", modes=4)
FAN = RecallConfig(sector_fov="auto", modes=4)
SIZE, CAPACITY, COUNT = 6, 32, 20
SEEDS = range(8)


def random_memory(stream, config, dtype=np.float64, count=COUNT):
    """A memory with all of its values random; the posterior lies on the first `count` rows."""
    empty = init_memory(config, SIZE, CAPACITY, np.dtype(dtype), groups=2)
    filled = jax.tree.map(lambda x: stream.uniform(0, 1, x.shape).astype(x.dtype), empty)
    rows = np.arange(CAPACITY) < count

    def modes():
        shape = empty.rest.shape
        inside = rows[: shape[1]]
        return Modes(
            stream.integers(0, count, config.modes).astype(np.int32),
            stream.normal(0, 0.1, (config.modes, 3)).astype(dtype),
            stream.dirichlet(np.ones(config.modes)).astype(dtype) / 2,
            stream.uniform(0, 1, shape).astype(dtype) * inside,
            stream.uniform(0, 0.01, shape).astype(dtype) * inside,
        )

    return filled._replace(
        **modes()._asdict(), control=modes(), count=np.int32(count), distinct=np.int32(7),
        view=stream.integers(1, 5, empty.view.shape).astype(empty.view.dtype) * rows,
        label=np.where(rows, stream.integers(0, 50, CAPACITY), -1).astype(np.int32),
    )  # fmt: skip


def poses_of(memory):
    return np.stack([memory.x, memory.y, np.arctan2(memory.sine, memory.cosine)], axis=1).astype(float)


def random_merge(stream, memory, turned=True):
    """Merges about half of the keyframes with older ones, of which some face opposite."""
    gone = stream.random(COUNT) < 0.5
    gone[0] = False
    kept = np.flatnonzero(~gone)
    onto = np.array([k if not gone[k] else stream.choice(kept[kept < k]) for k in range(COUNT)])
    offset = np.where(gone[:, None], stream.normal(0, 0.1, (COUNT, 3)), 0.0)
    offset[:, 2] += np.pi * (gone & (stream.random(COUNT) < 0.5) & turned)
    views = stream.integers(1, 5, (len(kept), SIZE)), stream.integers(0, 50, len(kept))
    merged = MergedRows(kept, *views, (np.cumsum(~gone) - 1)[onto], offset)
    pose = poses_of(memory)[:COUNT]
    pose[gone] = compose(pose[onto], offset)[gone]
    full = np.zeros((4, CAPACITY))
    full[:, :COUNT] = pose[:, 0], pose[:, 1], np.cos(pose[:, 2]), np.sin(pose[:, 2])
    return memory._replace(**dict(zip(("x", "y", "cosine", "sine"), full, strict=True))), merged


def posteriors(memory):
    """The own posterior and that of the control."""
    return [Modes(*(getattr(memory, name) for name in Modes._fields)), memory.control]


@pytest.mark.parametrize("config", [TOUCH, FAN])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_posterior_keeps_its_mass_and_its_places(seed, config):
    stream = np.random.default_rng(seed)
    memory, merged = random_merge(stream, random_memory(stream, config))
    after = merge_rows(memory, merged)
    for old, new in zip(posteriors(memory), posteriors(after), strict=True):
        assert np.array_equal(new.mass, old.mass)
        assert np.isclose(np.sum(new.rest), np.sum(old.rest))
        assert np.array_equal(new.anchor, merged.onto[old.anchor])
        there = compose(poses_of(memory)[old.anchor], old.offset)
        here = compose(poses_of(after)[np.asarray(new.anchor)], np.asarray(new.offset))
        off = here - there
        off[:, 2] = wrap(off[:, 2])
        assert np.abs(off).max() < 1e-12


@pytest.mark.parametrize("seed", SEEDS)
def test_mass_goes_to_the_row_and_direction_of_the_merged_keyframe(seed):
    stream = np.random.default_rng(seed)
    memory, merged = random_merge(stream, random_memory(stream, TOUCH))
    assert memory.rest.shape == (2, CAPACITY)
    for old, new in zip(posteriors(memory), posteriors(merge_rows(memory, merged)), strict=True):
        expected = np.zeros((2, CAPACITY))
        for row in range(COUNT):
            for shift in range(2):
                opposite = abs(wrap(merged.offset[row, 2])) > np.pi / 2
                expected[1 - shift if opposite else shift, merged.onto[row]] += old.rest[shift, row]
        assert np.allclose(new.rest, expected, atol=1e-15)


@pytest.mark.parametrize("seed", SEEDS)
def test_directions_stay_where_there_is_one_shift(seed):
    """A head whose whiskers are not opposite each other compares no turned images."""
    stream = np.random.default_rng(seed)
    memory, merged = random_merge(stream, random_memory(stream, TOUCH.model_copy(update={"shifts": 0})))
    assert memory.rest.shape == (1, CAPACITY)
    rest = merge_rows(memory, merged).rest
    expected = np.bincount(merged.onto, memory.rest[0, :COUNT], CAPACITY)
    assert np.allclose(rest[0], expected)


@pytest.mark.parametrize("config", [TOUCH, FAN])
@pytest.mark.parametrize("seed", SEEDS)
def test_rows_are_those_that_remain(seed, config):
    stream = np.random.default_rng(seed)
    memory, merged = random_merge(stream, random_memory(stream, config))
    after, rows = merge_rows(memory, merged), len(merged.source)
    assert int(after.count) == rows
    assert np.array_equal(np.asarray(after.view)[:, :rows], merged.view.T)
    assert np.array_equal(np.asarray(after.label)[:rows], merged.label)
    assert np.array_equal(np.asarray(after.packet)[:rows], memory.packet[merged.source])
    for name in ("x", "y", "cosine", "sine"):
        assert np.array_equal(np.asarray(getattr(after, name))[:rows], getattr(memory, name)[merged.source])
    if config is TOUCH:
        assert np.array_equal(np.asarray(after.before)[:, :rows], memory.before[:, merged.source])

    assert not np.asarray(after.view)[:, rows:].any()
    assert (np.asarray(after.label)[rows:] == -1).all()
    assert not np.asarray(after.packet)[rows:].any()
    for name in ("x", "y", "cosine", "sine", "before", "rest"):
        assert not np.asarray(getattr(after, name))[..., rows:].any(), name
    for name in ("distinct", "pose", "motion", "length", "turn", "bias", "turn_error", "since", "angle"):
        assert np.array_equal(getattr(after, name), getattr(memory, name)), name
    assert np.array_equal(after.likeness, memory.likeness)
    assert float(after.scale) == float(memory.scale)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes_and_dtypes_stay(dtype):
    stream = np.random.default_rng(0)
    memory, merged = random_merge(stream, random_memory(stream, TOUCH, dtype))
    memory = jax.tree.map(
        lambda x, like: np.asarray(x, like.dtype), memory, random_memory(stream, TOUCH, dtype)
    )
    after = merge_rows(memory, merged)
    assert jax.tree.map(np.shape, after) == jax.tree.map(np.shape, memory)
    assert jax.tree.map(lambda x: x.dtype, after) == jax.tree.map(lambda x: x.dtype, memory)
    leaves = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(after) if isinstance(leaf, jax.Array)]
    assert len(set(leaves)) == len(leaves)  # one buffer each, because the session donates them


def test_merged_keyframes_can_be_restored():
    """Twice as many rows: each former one comes back beside the one that it was merged with."""
    stream = np.random.default_rng(0)
    memory, count = random_memory(stream, TOUCH, count=10), 10
    source = np.repeat(np.arange(count), 2)
    views = stream.integers(1, 5, (2 * count, SIZE)), np.arange(2 * count)
    after = merge_rows(memory, MergedRows(source, *views, 2 * np.arange(count), np.zeros((count, 3))))
    assert int(after.count) == 2 * count
    assert np.array_equal(after.anchor, 2 * memory.anchor)
    assert np.array_equal(np.asarray(after.rest)[:, : 2 * count : 2], memory.rest[:, :count])
    assert not np.asarray(after.rest)[:, 1::2].any()
    assert np.array_equal(np.asarray(after.x)[1 : 2 * count : 2], memory.x[:count])


def test_more_rows_than_the_memory_holds_are_refused():
    memory = random_memory(np.random.default_rng(0), TOUCH)

    def rows(count):
        source = np.minimum(np.arange(count), COUNT - 1)
        views = np.ones((count, SIZE), int), np.zeros(count, int)
        return MergedRows(source, *views, np.arange(COUNT), np.zeros((COUNT, 3)))

    assert int(merge_rows(memory, rows(CAPACITY)).count) == CAPACITY
    with pytest.raises(ValueError, match=f"{CAPACITY + 1} keyframes do not fit into a memory of {CAPACITY}"):
        merge_rows(memory, rows(CAPACITY + 1))
