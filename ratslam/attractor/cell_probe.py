"""The activity of chosen cells and of all cells, read from whichever window level holds it."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from ratslam.attractor import window
from ratslam.attractor.config import PoseCellConfig
from ratslam.attractor.levels import Activity, Block, Level, to_full_torus
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.types import Array


class ProbedCells(NamedTuple):
    """Activity after one step.

    Attributes:
        chosen: [C] float32 of the chosen cells. every: [K * N * N] float32 of all cells over heading, y, x,
            zeros where the step is not due; None if no step is.
    """

    chosen: Array
    every: Array | None


def choose_cells(
    chosen: int | tuple[tuple[int, int, int], ...], config: PoseCellConfig, seed: int
) -> np.ndarray:
    """[C] int32 indices of cells in the flattened network.

    Args:
        chosen: their number, drawn without repetition from the whole network, in the order of the indices;
            or x, y, heading of each, in this order.

    Raises:
        InputError: the network has fewer cells, or not these.
    """
    rings = np.array([config.cells_xy, config.cells_xy, config.cells_heading])
    if isinstance(chosen, int):
        if chosen > np.prod(rings):
            raise InputError(
                "cells.chosen", str(chosen), f"at most {np.prod(rings)}, the cells of the network"
            )
        drawn = stream(seed, "attractor.recorded_cells").choice(int(np.prod(rings)), chosen, replace=False)
        return np.sort(drawn).astype(np.int32)
    at = np.array(chosen, np.int64).reshape(-1, 3)
    for number in np.flatnonzero((at >= rings).any(axis=1)):
        expected = f"x and y below {rings[0]}, heading below {rings[2]}, from 0 on"
        raise InputError(f"cells.chosen.{number}", str(at[number].tolist()), expected)
    return ((at[:, 2] * rings[1] + at[:, 1]) * rings[0] + at[:, 0]).astype(np.int32)


def is_due(number: Array, interval: int) -> Array:
    """Whether all cells are read after the step of this number (from 0): the last of each `interval`."""
    return (number + 1) % interval == 0


def probe_cells(
    levels: tuple[Level, ...], activity: Activity, number: Array, cell: np.ndarray, interval: int | None
) -> ProbedCells:
    """The activity after a step.

    Args:
        number: of the step, int32. cell: [C] chosen cells in the flattened network. interval: steps between
            two readings of all cells; None: they are never read.
    """
    chosen = activity_of(levels, activity, cell).astype(jnp.float32)
    if interval is None:
        return ProbedCells(chosen, None)
    count = int(np.prod(window.ring_sizes(levels[-1].window)))
    return ProbedCells(
        chosen,
        lax.cond(
            is_due(number, interval),
            lambda: to_full_torus(levels, activity).reshape(-1).astype(jnp.float32),
            lambda: jnp.zeros(count, jnp.float32),
        ),
    )


def activity_of(levels: tuple[Level, ...], activity: Activity, cell: np.ndarray) -> Array:
    """[C] activity of the cells with these indices [C] in the flattened network.

    All levels are read and one is kept: reading a few cells costs less than a branch.
    """
    rings = window.ring_sizes(levels[-1].window)
    row, x = np.divmod(cell, rings[0])
    heading, y = np.divmod(row, rings[1])
    at = np.stack([x, y, heading], axis=1).astype(np.int32)
    held = [_held(level, block, at) for level, block in zip(levels, activity.blocks, strict=True)]
    return jnp.stack(held)[activity.level]


def _held(level: Level, block: Block, at: np.ndarray) -> Array:
    """[C] the activity that a block holds at cells [C, 3] over x, y, heading: 0 outside its windows."""
    size = np.array(level.window.shape[::-1], np.int32)
    inside = (at[None] - block.origin[:, None]) % window.ring_sizes(level.window)[None, None]
    x, y, heading = jnp.moveaxis(jnp.minimum(inside, size[None, None] - 1), -1, 0)
    held = block.activity[np.arange(level.windows, dtype=np.int32)[:, None], heading, y, x]
    return jnp.sum(jnp.where(jnp.all(inside < size[None, None], axis=-1), held, 0.0), axis=0)
