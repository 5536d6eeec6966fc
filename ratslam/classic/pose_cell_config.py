"""Settings of the attractor network of RatSLAM as published."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, PositiveFloat, PositiveInt

from ratslam.network.config import PoseCellConfig
from tactile.base.settings import Settings


def _odd(width: int) -> int:
    if width % 2 == 0:
        raise ValueError("must be odd, so that the kernel is centred on a cell")
    return width


Width = Annotated[int, Field(ge=3, le=15), AfterValidator(_odd)]


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
