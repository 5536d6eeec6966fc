"""Eq. 2 of Fox et al. 2012 on distinct cells, the reading of the printed likelihood that the studies use."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from tactile.base.types import Array


def distinct_cells(cell: Array, contact: Array) -> Array:
    """bool [N, W, G]: each cell along a whisker counts once, and not as free where its contact is.

    Args:
        cell: [N, W, G, 2] cells at the points of each whisker, from base to tip. contact: [W] bool.
    """
    same = jnp.all(cell[:, :, :, None] == cell[:, :, None], axis=-1)  # [N, W, G, G]
    earlier = np.tri(cell.shape[2], k=-1, dtype=bool)
    repeated = jnp.any(same & earlier[None, None], axis=-1)
    return ~repeated & ~(same[..., -1] & contact[None, :, None])
