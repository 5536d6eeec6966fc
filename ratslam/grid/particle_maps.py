"""The maps of N particles, read and written through small windows, so that work is independent of map size.

A map holds evidence (log-odds, 0 where unexplored) and a vector field of doubled wall directions. Places are
in cells. Cells outside the map always count as unexplored.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from tactile.base.types import Array

EVIDENCE, COSINE, SINE = 0, 1, 2
LAYERS = 3


class Windows(NamedTuple):
    """One window per particle: corner [N, 2] int32, first column and row, and size in cells."""

    corner: Array
    size: int


def empty_maps(count: int, side: int, dtype: jnp.dtype) -> Array:
    """[N, layers, side, side] empty maps; rows are y, columns x."""
    return jnp.zeros((count, LAYERS, side, side), dtype)


def to_cells(point: Array, cell: float, side: int) -> Array:
    """[..., 2] positions in m as places in cells, from the middle of the first cell."""
    return point / cell + (side - 1) / 2


def windows_around(place: Array, side: int, size: int) -> Windows:
    """Windows of `size` x `size` cells around places [N, 2] in cells, moved to lie inside the map."""
    size = min(size, side)
    corner = jnp.floor(place).astype(jnp.int32) - (size // 2 - 1)
    return Windows(jnp.clip(corner, 0, side - size), size)


def read_window(maps: Array, windows: Windows, layer: int) -> Array:
    """[N, size, size] one layer of the maps inside the windows."""

    def read(rows: Array, corner: Array) -> Array:
        return lax.dynamic_slice(rows[layer], (corner[1], corner[0]), (windows.size, windows.size))

    return jax.vmap(read)(maps, windows.corner)


def write_window(maps: Array, windows: Windows, layer: int, values: Array) -> Array:
    """The maps with one layer inside the windows replaced by values [N, size, size]."""
    zero = jnp.int32(layer)

    def write(rows: Array, corner: Array, value: Array) -> Array:
        return lax.dynamic_update_slice(rows, value[None], (zero, corner[1], corner[0]))

    return jax.vmap(write)(maps, windows.corner, values)


def to_window(place: Array, windows: Windows) -> Array:
    """[N, K, 2] places in the windows, from places in the map; cells."""
    return place - windows.corner[:, None, :].astype(place.dtype)


def interpolate(maps: Array, layer: int, place: Array) -> Array:
    """[N, K] one layer at places [N, K, 2] in cells, interpolated bilinearly; 0 at the rim and outside."""
    count, layers, side, _ = maps.shape
    low = jnp.floor(place)
    inside = jnp.all((low >= 0) & (low < side - 1), axis=2)
    column, row = jnp.moveaxis(jnp.where(inside[:, :, None], low, 0.0).astype(jnp.int32), 2, 0)
    right, up = jnp.moveaxis(place - low, 2, 0)
    first = ((jnp.arange(count, dtype=jnp.int32)[:, None] * layers + layer) * side + row) * side + column
    flat = maps.reshape(-1)

    def at(index: Array) -> Array:
        return flat.at[index].get(mode="promise_in_bounds")

    below = at(first) * (1 - right) + at(first + 1) * right
    above = at(first + side) * (1 - right) + at(first + side + 1) * right
    return jnp.where(inside, below * (1 - up) + above * up, 0.0)
