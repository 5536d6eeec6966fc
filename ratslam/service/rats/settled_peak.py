"""The activity at which a cell fires at its peak rate."""

from __future__ import annotations

from functools import lru_cache

import jax
import numpy as np
from jax import lax

from ratslam.classic import pose_cells
from ratslam.classic.levels import to_full_torus, window_levels
from ratslam.classic.pose_cell_config import NetworkConfig
from tactile.base.types import Odometry

SETTLING = 60
"""Steps without motion; after 40 the peak of the default network changes by less than 1e-12 a step."""


def settled_peak(config: NetworkConfig) -> float:
    """The largest activity of a packet at rest on a cell, in the precision that JAX has by default.

    It depends on the network alone, so rates scaled by it can be compared between cells and recordings. A
    packet between cells, or in motion, is wider and its peak lower.
    """
    return _settled_peak(config, np.dtype(jax.dtypes.canonicalize_dtype(float)))


@lru_cache(maxsize=32)
def _settled_peak(config: NetworkConfig, dtype: np.dtype) -> float:
    levels = window_levels(config, dtype)
    zero = np.zeros((), dtype)
    still, nowhere = Odometry(zero, zero, zero, zero), np.zeros(3, dtype)

    def settle(_: object, cells: pose_cells.PoseCells) -> pose_cells.PoseCells:
        return pose_cells.step(config, levels, cells, still, nowhere, zero)[0]

    cells = jax.jit(lambda: lax.fori_loop(0, SETTLING, settle, pose_cells.start(config, dtype, levels)))()
    return float(np.asarray(to_full_torus(levels, cells.activity)).max())
