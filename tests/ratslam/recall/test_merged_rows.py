"""Rows of the recall memory after keyframes were merged or restored."""

import jax
import numpy as np
import pytest

from ratslam.recall.config import RecallConfig
from ratslam.recall.memory import MergedRows, init_memory

TOUCH, FAN = RecallConfig(sector_fov="whiskers"), RecallConfig(sector_fov="auto")
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
    source = np.append(merged.source, np.full(CAPACITY - rows, COUNT))  # rows from there on are empty
    expected = {name: getattr(memory, name)[source] * (source < COUNT) for name in PLACED}
    expected |= {"count": rows, "view": np.pad(merged.view.T, ((0, 0), (0, CAPACITY - rows)))}
    expected["label"] = np.append(merged.label, np.full(CAPACITY - rows, -1))
    expected["before"] = memory.before[..., source] * (source < COUNT) if config is TOUCH else memory.before
    for name, was in memory._asdict().items():
        assert np.array_equal(getattr(after, name), expected.get(name, was)), name


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_shapes_and_dtypes_stay(dtype):
    stream = np.random.default_rng(0)
    memory, merged = random_memory(stream, TOUCH, dtype), random_merge(stream)
    after = memory.merge_rows(merged)
    one, other = (jax.tree.map(lambda x: (np.shape(x), x.dtype), each) for each in (after, memory))
    assert one == other
    leaves = [leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(after) if isinstance(leaf, jax.Array)]
    assert len(set(leaves)) == len(leaves)  # one buffer each, because the session donates them


def test_merged_keyframes_can_be_restored_but_no_more_than_the_memory_holds():
    """Twice as many rows: each former one comes back beside the one that it was merged with."""
    stream, source = np.random.default_rng(0), np.repeat(np.arange(10), 2)
    memory, views = random_memory(stream, TOUCH, count=10), (stream.integers(1, 5, (20, SIZE)), np.arange(20))
    after = memory.merge_rows(MergedRows(source, 2 * np.arange(10), np.zeros((10, 3)), *views))
    assert int(after.count) == 20
    assert np.array_equal(np.asarray(after.x)[:20], memory.x[source])
    memory = random_memory(stream, TOUCH)

    def rows(count):
        source = np.minimum(np.arange(count), COUNT - 1)
        views = np.ones((count, SIZE), int), np.zeros(count, int)
        return MergedRows(source, np.arange(COUNT), np.zeros((COUNT, 3)), *views)

    assert int(memory.merge_rows(rows(CAPACITY)).count) == CAPACITY
    with pytest.raises(ValueError, match=f"{CAPACITY + 1} keyframes do not fit into a memory of {CAPACITY}"):
        memory.merge_rows(rows(CAPACITY + 1))
