"""Recall in replay: one frame compared with many remembered ones, on one core."""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ratslam.recall import observation_model
from ratslam.recall.config import RecallConfig
from ratslam.recall.filter import recognise
from ratslam.recall.memory import MapFeedback, accumulate_motion, apply_map_feedback, init_memory

CELL = 0.6


def remembered(config: RecallConfig, frames: int, size: int, dtype):
    """A memory of a random walk with random views, with modes in use."""
    stream = np.random.default_rng(0)
    capacity = 1 << (frames - 1).bit_length()
    memory = init_memory(config, size, capacity, np.dtype(dtype))
    turns = np.cumsum(stream.normal(0, 0.3, frames))
    steps = 0.5 * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    poses = np.column_stack([np.cumsum(steps, axis=0), turns])
    memory = memory._replace(
        view=jnp.asarray(stream.random((size, capacity)), dtype), count=jnp.int32(frames - 1)
    )
    return apply_map_feedback(memory, MapFeedback(poses, 0.01, 0.0, 5.0, np.pi / 18, 0.06))


@pytest.mark.parametrize("shifts", [0, 3])
@pytest.mark.parametrize("frames", [1500, 100_000])
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_one_recall(benchmark, frames, shifts, dtype):
    config = RecallConfig(shifts=shifts)
    memory = remembered(config, frames, 18, dtype)
    views = jnp.asarray(np.random.default_rng(1).random((64, 18)), dtype)
    looks = max(4, 300_000 // frames)
    moved = jnp.asarray([0.5, 0.0, 0.1], dtype)

    @jax.jit
    def replay(memory):
        def recall(k, memory):
            memory = accumulate_motion(memory, moved)
            weighed = observation_model.view_likelihood(config, CELL, memory, views[k % 64])
            memory, _ = recognise(config, CELL, memory, weighed, config.local)
            return memory._replace(motion=jnp.zeros_like(moved), length=jnp.zeros_like(memory.length))

        return jax.lax.fori_loop(0, looks, recall, memory)

    replay(memory).mass.block_until_ready()
    times = []
    for _ in range(5):
        start = time.perf_counter()
        replay(memory).mass.block_until_ready()
        times.append((time.perf_counter() - start) / looks)
    median = float(np.median(times)) * 1e6
    benchmark.extra_info["us_a_look"] = median
    print(f"\n{frames} frames, {2 * shifts + 1} shifts, {dtype}: {median:.0f} us a recall")
    after = benchmark.pedantic(replay, args=(memory,), rounds=1)
    assert np.isfinite(np.asarray(after.mass)).all()
