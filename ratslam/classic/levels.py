"""Window levels: the sizes of window that the network is computed on, and the activity held at one of them.

A settled packet fills some 200 cells, however large the torus is. The levels are, from small to large: one
small window that moves with the packet; two small windows with one common normalisation, for a packet and a
distant injection; one larger window; the whole torus.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.classic import excitation_inhibition as window
from ratslam.classic.excitation_inhibition import Window
from ratslam.classic.pose_cell_config import NetworkConfig
from ratslam.core.estimates import PoseCellActivity
from tactile.base.types import Array

SETTLED = 10
"""Cells across a settled packet, inside the small window (16^3 cells with the default kernels)."""
WIDE = 26
"""Cells inside the larger window (32^3)."""
LARGEST_SHARE = 0.5
"""Levels with more than this share of the cells of the torus are omitted."""


class Level(NamedTuple):
    """A number of windows of one shape, one for each packet. follows_pose: the window follows the decoded
    pose of its packet; otherwise the middle of all activity in it."""

    window: Window
    windows: int
    follows_pose: bool = False


class Block(NamedTuple):
    """The activity of one level: activity [C, H, Y, X] of its windows, and origin [C, 3], int32, the first
    cell of each window over x, y, heading."""

    activity: Array
    origin: Array


class Activity(NamedTuple):
    """One block for each level, of which only that of `level` (int32) is valid."""

    blocks: tuple[Block, ...]
    level: Array


def window_levels(config: NetworkConfig, dtype: np.dtype) -> tuple[Level, ...]:
    """The levels from the smallest to the whole torus."""
    torus = Level(window.make_window(config, None, dtype), 1)
    if config.engine == "dense":
        return (torus,)
    small, wide = (window.make_window(config, inner, dtype) for inner in (SETTLED, WIDE))
    lower = [Level(small, 1, follows_pose=True), Level(small, 2), Level(wide, 1)]
    most = LARGEST_SHARE * np.prod(torus.window.shape)
    return (*(level for level in lower if level.windows * np.prod(level.window.shape) <= most), torus)


def empty_block(level: Level, dtype: np.dtype) -> Block:
    """A block without activity."""
    shape = (level.windows, *level.window.shape)
    return Block(jnp.zeros(shape, dtype), jnp.zeros((level.windows, 3), jnp.int32))


def point_activity(levels: tuple[Level, ...], pose: Array) -> Activity:
    """Unit activity at a pose [3], shared among its neighbour cells, at the smallest level."""
    smallest, dtype = levels[0].window, pose.dtype
    origin = window.origin_centred_on(smallest, pose)
    cells = window.deposit(smallest, jnp.zeros(smallest.shape, dtype), origin, pose, jnp.ones((), dtype))
    above = tuple(empty_block(level, dtype) for level in levels[1:])
    return Activity((Block(cells[None], origin[None]), *above), jnp.int32(0))


def to_full_torus(levels: tuple[Level, ...], activity: Activity) -> Array:
    """[K, N, N] the activity of the whole torus."""
    return block_at(levels, len(levels) - 1, activity, jnp.zeros(3, jnp.int32)).activity[0]


def activity_sums(levels: tuple[Level, ...], activity: Activity) -> PoseCellActivity:
    """The activity summed over the headings, and over x and y; on the host, without compiling."""
    sizes = window.ring_sizes(levels[-1].window)
    xy, heading = np.zeros(sizes[1::-1]), np.zeros(sizes[2])
    block = activity.blocks[int(activity.level)]
    for cells, origin in zip(np.asarray(block.activity), np.asarray(block.origin), strict=True):
        at = [
            (first + np.arange(size)) % ring
            for first, size, ring in zip(origin[::-1], cells.shape, sizes[::-1], strict=True)
        ]
        np.add.at(xy, np.ix_(at[1], at[2]), cells.sum(axis=0))
        np.add.at(heading, at[0], cells.sum(axis=(1, 2)))
    return PoseCellActivity(xy, heading)


def from_full_torus(levels: tuple[Level, ...], activity: Array) -> Activity:
    """Activity [K, N, N] of the whole torus, at the last level."""
    below = tuple(empty_block(level, activity.dtype) for level in levels[:-1])
    return Activity((*below, Block(activity[None], jnp.zeros((1, 3), jnp.int32))), jnp.int32(len(levels) - 1))


def block_at(levels: tuple[Level, ...], k: int, activity: Activity, origin: Array) -> Block:
    """The activity at level k, from whichever level up to k holds it; a new window begins at `origin` [3]."""

    def transfer_from(j: int) -> Callable[[], Block]:
        if j == k:
            return lambda: activity.blocks[k]
        return lambda: transfer(levels[j], activity.blocks[j], levels[k], origin)

    return lax.switch(jnp.minimum(activity.level, k), [transfer_from(j) for j in range(k + 1)])


def transfer(source: Level, block: Block, target: Level, origin: Array) -> Block:
    """A block at another level: the same windows and empty ones, or one window from `origin` [3] on."""
    more = target.windows - source.windows
    if more > 0:
        return jax.tree.map(lambda leaf: jnp.pad(leaf, [(0, more)] + [(0, 0)] * (leaf.ndim - 1)), block)
    ring = window.ring_sizes(source.window)[::-1]

    def cut(cells: Array, first: Array) -> Array:
        for k, axis in enumerate(target.window.axes):
            size = source.window.shape[k]
            at = (origin[2 - k] - first[2 - k] + np.arange(axis.size, dtype=np.int32)) % ring[k]
            part = jnp.take(cells, jnp.minimum(at, size - 1), axis=k)
            cells = jnp.where((at < size).reshape([-1 if a == k else 1 for a in range(3)]), part, 0.0)
        return cells

    cells = jnp.sum(jax.vmap(cut)(block.activity, block.origin), axis=0)
    return Block(cells[None], origin[None])


def extent(shape: Window, block: Block) -> tuple[Array, Array, Array]:
    """[3] first and last cells with activity over x, y, heading of one window, and bool: there are any."""
    cells, dtype = block.activity > 0, block.activity.dtype
    low, high = [], []
    for k, axis in zip((2, 1, 0), shape.axes[::-1], strict=True):
        among = jnp.any(cells, axis=tuple(a for a in range(3) if a != k))
        low.append(jnp.argmax(among))
        high.append(axis.size - 1 - jnp.argmax(among[::-1]))
    first = block.origin.astype(dtype)
    return first + jnp.stack(low).astype(dtype), first + jnp.stack(high).astype(dtype), jnp.any(cells)


def total(activity: Activity) -> Array:
    """The sum of all activity."""
    sums = jnp.stack([jnp.sum(block.activity) for block in activity.blocks])
    return sums[activity.level]
