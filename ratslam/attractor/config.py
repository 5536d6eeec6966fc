"""The configuration of the pose cells."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field, PositiveFloat, PositiveInt

from tactile.base.config import Settings


def _odd(width: int) -> int:
    if width % 2 == 0:
        raise ValueError("must be odd, so that a kernel has a middle")
    return width


Width = Annotated[int, Field(ge=3, le=15), AfterValidator(_odd)]


class PoseCellConfig(Settings):
    """The pose-cell network."""

    cells_xy: Annotated[int, Field(ge=7, le=1001)] = 21
    """Cells along x and along y."""
    cells_heading: Annotated[int, Field(ge=7, le=720)] = 36
    """Cells around the heading ring."""
    cell_size: PositiveFloat = 0.1
    """Side of a cell, m."""
    excite_width: Width = 7
    """Cells across the excitation kernel, odd."""
    excite_sigma: PositiveFloat = 1.0
    """Standard deviation of excitation, cells."""
    inhibit_width: Width = 5
    """Cells across the inhibition kernel, odd."""
    inhibit_sigma: PositiveFloat = 2.0
    """Standard deviation of inhibition, cells."""
    global_inhibition: Annotated[float, Field(ge=0, lt=0.1)] = 2e-5
    """Activity taken from every cell at each sub-step."""
    settle_steps: PositiveInt = 10
    """Steps after an injection during which the packet's lag is not measured: it moves by recall then."""
    engine: Literal["window", "dense"] = "window"
    """`window`: only the cells around the packet are worked on, more of them where that is not exact;
    `dense`: always all. Both give the same."""


def rings(config: PoseCellConfig, dtype: np.dtype) -> np.ndarray:
    """[3] cells around x, y and heading."""
    return np.array([config.cells_xy, config.cells_xy, config.cells_heading], dtype)


def units(config: PoseCellConfig, dtype: np.dtype) -> np.ndarray:
    """[3] size of a cell along x, y and heading: m, m, rad."""
    return np.array([config.cell_size, config.cell_size, 2 * np.pi / config.cells_heading], dtype)
