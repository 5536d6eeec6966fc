"""Settings of the attractor network of RatSLAM as published, and of the recording of pose cells."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Discriminator, Field, PositiveFloat, PositiveInt, Tag, field_validator

from ratslam.network.config import PoseCellConfig, SheetConfig
from tactile.base.settings import Settings

CellIndex = Annotated[int, Field(ge=0)]
Number = Annotated[CellIndex, Tag("number")]
Positions = Annotated[tuple[tuple[CellIndex, CellIndex, CellIndex], ...], Tag("list")]
Chosen = Annotated[
    Number | Positions, Discriminator(lambda value: "list" if isinstance(value, list | tuple) else "number")
]


Extent = tuple[float, float, float, float] | None


class CellSumsConfig(Settings):
    """Sums of the activity of all cells over bins of the true pose; steps whose true pose is not known or
    outside the extent are left out."""

    bins: Annotated[int, Field(ge=1, le=500)] = 20
    """Place bins along x and along y."""
    heading_bins: Annotated[int, Field(ge=1, le=720)] = 36
    """Heading bins, the first centred on heading 0."""
    rate: PositiveFloat = 10.0
    """Summed steps per second, each for the time since the one before; every step of a slower source."""
    extent: Extent = None
    """The binned rectangle x0, y0, x1, y1, m, in the frame of the true poses. null: that of the true path,
    where it is known before the run: of simulations and recordings held in memory."""

    @field_validator("extent")
    @classmethod
    def _has_area(cls, extent: Extent) -> Extent:
        if extent is not None and not (extent[0] < extent[2] and extent[1] < extent[3]):
            raise ValueError("x0, y0, x1, y1 with x0 < x1 and y0 < y1")
        return extent


class CellsConfig(Settings):
    """Recording of the pose cells."""

    chosen: Chosen = 64
    """Cells whose activity is recorded at every step: their number, drawn from the whole network by
    `session.seed`; or the indices x, y, heading of each."""
    sums: CellSumsConfig | None = None
    """Sums of the activity of all cells; null: none."""
    sheet: SheetConfig | None = None
    """With `backend: recall`: record grid cells that read the belief instead of the pose cells; null: not."""


Width = Annotated[int, Field(ge=3, le=15)]


class AttractorConfig(Settings):
    """Settings of the attractor network."""

    excite_width: Width = 7
    """Cells across the excitation kernel, odd."""
    excite_sigma: PositiveFloat = 1.0
    """Standard deviation of excitation, cells."""
    inhibit_width: Width = 5
    """Cells across the inhibition kernel, odd."""
    inhibit_sigma: PositiveFloat = 2.0
    """Standard deviation of inhibition, cells."""
    global_inhibition: Annotated[float, Field(ge=0, lt=0.1)] = 2e-5
    """Activity subtracted from every cell at each sub-step."""
    settle_steps: PositiveInt = 10
    """Steps after an injection during which the lag is not measured, because recall moves the packet then."""
    engine: Literal["window", "dense"] = "window"
    """`window`: compute the smallest window of cells that is exact; `dense`: always the whole torus. The
    results are equal."""

    @field_validator("excite_width", "inhibit_width")
    @classmethod
    def _is_odd(cls, width: int) -> int:
        if width % 2 == 0:
            raise ValueError("must be odd, so that the kernel is centred on a cell")
        return width


class NetworkConfig(AttractorConfig, PoseCellConfig):
    """A pose-cell network as published: its cells and their dynamics."""


def network_of(pose_cells: PoseCellConfig, attractor: AttractorConfig) -> NetworkConfig:
    """The network of two sections of a configuration."""
    return NetworkConfig(**dict(pose_cells), **dict(attractor))


def rings(config: PoseCellConfig, dtype: np.dtype) -> np.ndarray:
    """[3] cells of the torus along x, y and heading."""
    return np.array([config.cells_xy, config.cells_xy, config.cells_heading], dtype)


def units(config: PoseCellConfig, dtype: np.dtype) -> np.ndarray:
    """[3] cell size along x, y and heading: m, m, rad."""
    return np.array([config.cell_size, config.cell_size, 2 * np.pi / config.cells_heading], dtype)
