"""Maps of many particles, read and written through small windows: work follows what is touched, not the map.

A map holds evidence (log-odds, 0 where nothing was felt) and the doubled directions of walls as a field of
vectors. Places are in cells. What lies near a particle is changed in a window that is cut out of its map and
put back. What lies outside the map is unexplored for ever.
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
    """Where each particle's window lies: [N, 2] int32 first column and row."""

    corner: Array
    size: int


def blank(count: int, side: int, dtype: jnp.dtype) -> Array:
    """[N, layers, side, side] empty maps; rows are y, columns x."""
    return jnp.zeros((count, LAYERS, side, side), dtype)


def in_cells(point: Array, cell: float, side: int) -> Array:
    """[..., 2] m as places in the map, in cells from the middle of the first one."""
    return point / cell + (side - 1) / 2


def around(place: Array, side: int, size: int) -> Windows:
    """The windows of `size` cells a side about places [N, 2] in cells, inside the map."""
    size = min(size, side)
    corner = jnp.floor(place).astype(jnp.int32) - (size // 2 - 1)
    return Windows(jnp.clip(corner, 0, side - size), size)


def cut(maps: Array, windows: Windows, layer: int) -> Array:
    """[N, size, size] one layer of the maps inside the windows."""

    def one(rows: Array, corner: Array) -> Array:
        return lax.dynamic_slice(rows[layer], (corner[1], corner[0]), (windows.size, windows.size))

    return jax.vmap(one)(maps, windows.corner)


def put(maps: Array, windows: Windows, layer: int, values: Array) -> Array:
    """The maps with one layer inside the windows replaced by values [N, size, size]."""
    zero = jnp.int32(layer)

    def one(rows: Array, corner: Array, value: Array) -> Array:
        return lax.dynamic_update_slice(rows, value[None], (zero, corner[1], corner[0]))

    return jax.vmap(one)(maps, windows.corner, values)


def within(place: Array, windows: Windows) -> Array:
    """Places [N, K, 2] in cells of the map as places in the windows."""
    return place - windows.corner[:, None, :].astype(place.dtype)


def read(maps: Array, layer: int, place: Array) -> Array:
    """[N, K] bilinear values of one layer at places [N, K, 2] in cells; at the rim and outside it is 0."""
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
