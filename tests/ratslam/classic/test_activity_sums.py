"""Sums of the activity, taken on the host."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from ratslam.classic.config import NetworkConfig
from ratslam.classic.levels import Activity, Block, activity_sums, to_full_torus, window_levels

LEVELS = window_levels(NetworkConfig(cells_xy=45, cells_heading=72), np.dtype(np.float64))


def test_sums_are_those_of_the_whole_torus_at_every_level():
    random = np.random.default_rng(0)
    assert len(LEVELS) == 4
    for number in range(len(LEVELS)):
        blocks = []
        for level in LEVELS:
            cells = random.random((level.windows, *level.window.shape))
            whole = level is LEVELS[-1]
            origin = np.zeros((1, 3)) if whole else random.integers(0, (45, 45, 72), (level.windows, 3))
            blocks.append(Block(jnp.asarray(cells), jnp.asarray(origin, jnp.int32)))  # over the seams
        activity = Activity(tuple(blocks), jnp.int32(number))
        full = np.asarray(to_full_torus(LEVELS, activity))
        sums = activity_sums(LEVELS, activity)
        assert np.allclose(sums.xy, full.sum(axis=0), rtol=1e-12, atol=0.0)
        assert np.allclose(sums.heading, full.sum(axis=(1, 2)), rtol=1e-12, atol=0.0)
