"""Rows of the recall memory after keyframes were merged or restored."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from ratslam.recall.config import RecallConfig
from ratslam.recall.memory import MergedRows, init_memory

TOUCH = RecallConfig(sector_fov="whiskers")
FAN = RecallConfig(sector_fov="auto")
SIZE, CAPACITY, COUNT = 6, 32, 20
PLACED = "x", "y", "heading", "cosine", "sine"


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


def random_merge(stream):
    """Merges about half of the keyframes with older ones."""
    gone = stream.random(COUNT) < 0.5
    gone[0] = False
    kept = np.flatnonzero(~gone)
    onto = np.array([k if not gone[k] else stream.choice(kept[kept < k]) for k in range(COUNT)])
    offset = np.where(gone[:, None], stream.normal(0, 0.1, (COUNT, 3)), 0.0)
    views = stream.integers(1, 5, (len(kept), SIZE)), stream.integers(0, 50, len(kept))
    return MergedRows(kept, (np.cumsum(~gone) - 1)[onto], offset, *views)


@pytest.mark.parametrize("config", [TOUCH, FAN])
@pytest.mark.parametrize("seed", range(3))
def test_rows_are_those_that_remain(seed, config):
    stream = np.random.default_rng(seed)
    memory, merged = random_memory(stream, config), random_merge(stream)
    after, rows = memory.merge_rows(merged), len(merged.source)
    assert int(after.count) == rows
    assert np.array_equal(np.asarray(after.view)[:, :rows], merged.view.T)
    assert np.array_equal(np.asarray(after.label)[:rows], merged.label)
    for name in PLACED:
        assert np.array_equal(np.asarray(getattr(after, name))[:rows], getattr(memory, name)[merged.source])
    if config is TOUCH:
        assert np.array_equal(np.asarray(after.before)[:, :rows], memory.before[:, merged.source])

    assert not np.asarray(after.view)[:, rows:].any()
    assert (np.asarray(after.label)[rows:] == -1).all()
    for name in (*PLACED, "before"):
        assert not np.asarray(getattr(after, name))[..., rows:].any(), name
    for name in ("distinct", "pose", "motion", "length", "turn", "bias", "turn_error", "since", "angle"):
        assert np.array_equal(getattr(after, name), getattr(memory, name)), name
    assert np.array_equal(after.likeness, memory.likeness)
    assert float(after.scale) == float(memory.scale)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes_and_dtypes_stay(dtype):
    stream = np.random.default_rng(0)
    memory, merged = random_memory(stream, TOUCH, dtype), random_merge(stream)
    after = memory.merge_rows(merged)
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
    after = memory.merge_rows(MergedRows(source, 2 * np.arange(count), np.zeros((count, 3)), *views))
    assert int(after.count) == 2 * count
    for begin in (0, 1):
        assert np.array_equal(np.asarray(after.x)[begin : 2 * count : 2], memory.x[:count])


def test_more_rows_than_the_memory_holds_are_refused():
    memory = random_memory(np.random.default_rng(0), TOUCH)

    def rows(count):
        source = np.minimum(np.arange(count), COUNT - 1)
        views = np.ones((count, SIZE), int), np.zeros(count, int)
        return MergedRows(source, np.arange(COUNT), np.zeros((COUNT, 3)), *views)

    assert int(memory.merge_rows(rows(CAPACITY)).count) == CAPACITY
    with pytest.raises(ValueError, match=f"{CAPACITY + 1} keyframes do not fit into a memory of {CAPACITY}"):
        memory.merge_rows(rows(CAPACITY + 1))
