"""The activity of chosen cells and of all cells, read from whichever window level holds it."""

from __future__ import annotations

import math
from functools import partial

import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.classic.levels import Activity, Levels
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Array


def choose_cells(
    chosen: int | tuple[tuple[int, int, int], ...], shape: tuple[int, int, int], seed: int
) -> np.ndarray:
    """[C] int32 indices of cells in the flattened network.

    Args:
        chosen: their number, drawn without repetition from the whole network, in the order of the indices;
            or x, y, heading of each, in this order. shape: cells over heading, y, x.

    Raises:
        InputError: the network has fewer cells, or not these.
    """
    rings, size = np.array(shape[::-1]), math.prod(shape)
    if isinstance(chosen, int):
        if chosen > size:
            raise InputError("cells.chosen", str(chosen), f"at most {size}, the cells of the network")
        drawn = stream(seed, "attractor.recorded_cells").choice(size, chosen, replace=False)
        return np.sort(drawn).astype(np.int32)
    at = np.array(chosen, np.int64).reshape(-1, 3)
    for number in np.flatnonzero((at >= rings).any(axis=1)):
        expected = f"x and y below {rings[0]}, heading below {rings[2]}, from 0 on"
        raise InputError(f"cells.chosen.{number}", str(at[number].tolist()), expected)
    return ((at[:, 2] * rings[1] + at[:, 1]) * rings[0] + at[:, 0]).astype(np.int32)


def hold_cells(levels: Levels, activity: Activity) -> tuple[Array, Array, Array]:
    """The windows of the level that holds the activity, for `active_cells`: a window of 16^3 cells is read
    and summed in a fraction of the time that the whole torus takes.

    Returns:
        level, int32; origin [M, 3] int32, the first cell of each window over x, y, heading, then zeros, for
        the level with most windows; cells [K * N * N] float32, the windows flattened, then zeros.
    """
    size = int(np.prod(levels[-1].window.shape))
    most = max(level.windows for level in levels)

    def held_at(k: int) -> tuple[Array, Array]:
        block = activity.blocks[k]
        cells = block.activity.reshape(-1).astype(jnp.float32)
        origin = jnp.pad(block.origin, ((0, most - levels[k].windows), (0, 0)))
        return origin, jnp.pad(cells, (0, size - len(cells)))

    choices = [partial(held_at, k) for k in range(len(levels))]
    return activity.level, *lax.switch(activity.level, choices)


def active_cells(levels: Levels, held: tuple[Array, Array, Array]) -> tuple[np.ndarray, np.ndarray]:
    """Indices [n] of the active cells in the flattened network and their activity [n] float32, on the host; a
    cell comes twice where two windows overlap."""
    number, origin, cells = held
    level = levels[int(number)]
    shape = (level.windows, *level.window.shape)
    at = np.flatnonzero(cells[: math.prod(shape)])
    copy, *inside = np.unravel_index(at, shape)
    x, y, heading = level.window.ring_sizes().tolist()
    own = [(origin[copy, 2 - k] + inside[k]) % ring for k, ring in enumerate((heading, y, x))]
    return (own[0] * y + own[1]) * x + own[2], cells[at]


def activity_of(levels: Levels, activity: Activity, cell: np.ndarray) -> Array:
    """[C] activity of the cells with these indices [C] in the flattened network.

    All levels are read and one is kept: reading a few cells costs less than a branch.
    """
    rings = levels[-1].window.ring_sizes()
    row, x = np.divmod(cell, rings[0])
    heading, y = np.divmod(row, rings[1])
    at = np.stack([x, y, heading], axis=1).astype(np.int32)
    held = []
    for level, block in zip(levels, activity.blocks, strict=True):
        size = np.array(level.window.shape[::-1], np.int32)
        inside = (at[None] - block.origin[:, None]) % rings[None, None]  # [M, C, 3] places in each window
        x, y, heading = jnp.moveaxis(jnp.minimum(inside, size[None, None] - 1), -1, 0)
        found = block.activity[np.arange(level.windows, dtype=np.int32)[:, None], heading, y, x]
        within = jnp.all(inside < size[None, None], axis=-1)
        held.append(jnp.sum(jnp.where(within, found, 0.0), axis=0))
    return jnp.stack(held)[activity.level]
