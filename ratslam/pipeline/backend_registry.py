"""The methods by name: what a configuration asks for, made ready."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from ratslam.attractor import pose_cells
from ratslam.backends import grid
from ratslam.backends.grid import GridEvidence, GridFilter
from ratslam.backends.recall import evidence_of, rat
from ratslam.config.run_config import RunConfig
from ratslam.core.backend import Backend
from ratslam.grid.particle_maps import LAYERS
from tactile.base.errors import InputError
from tactile.whiskers.planar_whiskers import Feelers

LIVE_SIDE = 2.5
"""Side of a map of which nothing is known beforehand, m (Fox et al. 2012, II-D)."""
MOST = 2**31 - 1
"""Cells of all maps together: they are numbered in int32."""
ARRAYS = ("packet", "background", "ancestor", "poses", "weights")
"""What evidence holds that is no single number."""


class Telling(NamedTuple):
    """How a backend's steps are written down: names of its single values, and its outcomes."""

    columns: tuple[str, ...]
    outcomes: type[IntEnum]


def backend_of(config: RunConfig, view_shape: tuple[int, int, int], feelers: Feelers | None) -> Backend:
    """The backend of a completed configuration for observations of that shape.

    Raises:
        InputError: it needs whiskers and there are none, or its maps have more cells than can be counted.
    """
    precision = np.dtype(config.session.precision)
    if config.backend == "rat":
        return rat(config.rat(), view_shape, precision)
    if feelers is None:
        raise InputError("backend", "grid, for a recording without whiskers", "rat, or a session of whiskers")
    grid, side = config.grid, config.grid.side or LIVE_SIDE
    cells = grid.particles * LAYERS * int(np.ceil(side / grid.cell)) ** 2
    if cells > MOST:
        found = f"{grid.particles} particles with maps of {side:g} m in cells of {grid.cell:g} m"
        raise InputError(
            "grid", found, "2^31 cells in all", "fewer particles, coarser cells or a smaller map"
        )
    return GridFilter(grid, feelers, side, precision)


def telling(config: RunConfig) -> Telling:
    """What each step reports."""
    evidence = GridEvidence if config.backend == "grid" else evidence_of(config.matcher)
    outcomes: type[IntEnum] = grid.Outcome if config.backend == "grid" else pose_cells.Outcome
    quiet = {*ARRAYS, "outcome"}
    return Telling(tuple(name for name in evidence._fields if name not in quiet), outcomes)
