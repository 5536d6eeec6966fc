"""Settings of the pose cells, and the network that follows from them."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from pydantic import Field, PositiveFloat

from tactile.base.settings import Settings


class PoseCellConfig(Settings):
    """Number and size of the pose cells."""

    cells_xy: Annotated[int, Field(ge=7, le=1001)] = 21
    """Cells along x and along y. With `backend: recall` those at first: a side doubles where the map outgrows
    it."""
    cells_heading: Annotated[int, Field(ge=7, le=720)] = 36
    """Cells around the heading ring."""
    cell_size: PositiveFloat = 0.1
    """Cell side length, m."""


class Network(NamedTuple):
    """The network of the belief, see `ratslam.network.pose_cells`.

    Attributes:
        cells: their number and size. excite: standard deviation of local excitation over x and y, cells, and
            excite_heading: over heading, rad. miss: weight of the case that no view cell is where a packet
            is, relative to one exactly there. leak: share of a packet that is lost at every view.
    """

    cells: PoseCellConfig
    excite: float
    excite_heading: float
    miss: float
    leak: float


class SheetConfig(Settings):
    """A sheet of grid cells that read the belief of `backend: recall`, see `ratslam.network.grid_cells`."""

    spacing: PositiveFloat
    """Distance between neighbouring fields of a cell, m."""
    twisted: bool = True
    """Whether a turn along y shifts x by half a turn: fields of a cell are then on a hexagonal lattice, else
    on a square one."""
