"""Recall in replay: one frame compared with many remembered ones, and the pose cells driven by them, on one
core."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.network import pose_cells
from ratslam.network.config import Network, PoseCellConfig
from ratslam.recall import observation_model
from ratslam.recall.config import RecallConfig
from ratslam.recall.filter import recognise
from ratslam.recall.memory import MapFeedback, init_memory

CELL = 0.6


def remembered(config: RecallConfig, frames: int, size: int, dtype):
    """A memory of a random walk with random views, and its poses [N, 3]."""
    stream = np.random.default_rng(0)
    capacity = 1 << (frames - 1).bit_length()
    memory = init_memory(config, size, capacity, np.dtype(dtype))
    turns = np.cumsum(stream.normal(0, 0.3, frames))
    steps = 0.5 * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    poses = np.column_stack([np.cumsum(steps, axis=0), turns])
    memory = memory._replace(
        view=jnp.asarray(stream.random((size, capacity)), dtype), count=jnp.int32(frames - 1)
    )
    return memory.apply_map_feedback(MapFeedback(poses, 0.01, 0.0, 5.0, np.pi / 18, 0.06)), poses


@pytest.mark.parametrize("shifts", [0, 3])
@pytest.mark.parametrize("frames", [1500, 100_000])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_one_recall(benchmark, frames, shifts, dtype):
    config = RecallConfig(shifts=shifts)
    memory, poses = remembered(config, frames, 18, dtype)
    network = Network(
        PoseCellConfig(cell_size=CELL), config.excite, config.excite_heading, config.miss, config.leak
    )
    silent = pose_cells.start(network, (2 * shifts + 1, len(memory.label)))
    belief = pose_cells.cover(network, silent, pose_cells.sides_for(network, poses))
    views = jnp.asarray(np.random.default_rng(1).random((64, 18)), dtype)
    looks = max(4, 300_000 // frames)
    moved = jnp.asarray([0.5, 0.0, 0.1], dtype)

    @jax.jit
    def replay(memory, belief):
        def recall(k, carry):
            memory, belief = carry
            memory = memory.accumulate_motion(moved)
            motion = memory.corrected_motion()
            weighed = observation_model.view_likelihood(config, CELL, memory, views[k % 64])
            belief, _ = recognise(config, network, memory, belief, motion, weighed, config.local)
            zero = jnp.zeros_like(memory.length)
            return memory._replace(motion=jnp.zeros_like(moved), length=zero), belief

        return jax.lax.fori_loop(0, looks, recall, (memory, belief))[1]

    replay(memory, belief).mass.block_until_ready()
    times = []
    for _ in range(5):
        start = time.perf_counter()
        replay(memory, belief).mass.block_until_ready()
        times.append((time.perf_counter() - start) / looks)
    median = float(np.median(times)) * 1e6
    benchmark.extra_info["us_a_look"] = median
    sides = belief.activity.shape[:0:-1]
    print(f"\n{frames} frames, {2 * shifts + 1} shifts, {sides} cells, {dtype}: {median:.0f} us a recall")
    after = benchmark.pedantic(replay, args=(memory, belief), rounds=1)
    assert np.isfinite(np.asarray(after.activity)).all()
    assert 0 < float(after.activity.sum()) <= 1 + 1e-3
