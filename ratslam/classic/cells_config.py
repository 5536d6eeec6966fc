"""Settings of the recording of pose cells."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Field, PositiveFloat, Tag, field_validator

from tactile.base.settings import Settings


def _form(value: Any) -> str:
    return "list" if isinstance(value, list | tuple) else "number"


CellIndex = Annotated[int, Field(ge=0)]
Number = Annotated[CellIndex, Tag("number")]
Positions = Annotated[tuple[tuple[CellIndex, CellIndex, CellIndex], ...], Tag("list")]


class CellSumsConfig(Settings):
    """Sums of the activity of all cells over bins of the true pose; steps whose true pose is not known or
    outside the extent are left out."""

    bins: Annotated[int, Field(ge=1, le=500)] = 20
    """Place bins along x and along y."""
    heading_bins: Annotated[int, Field(ge=1, le=720)] = 36
    """Heading bins, the first centred on heading 0."""
    rate: PositiveFloat = 10.0
    """Summed steps per second, each for the time since the one before; every step of a slower source."""
    extent: tuple[float, float, float, float] | None = None
    """The binned rectangle x0, y0, x1, y1, m, in the frame of the true poses. null: that of the true path,
    where it is known before the run: of simulations and recordings held in memory."""

    @field_validator("extent")
    @classmethod
    def _has_area(
        cls, extent: tuple[float, float, float, float] | None
    ) -> tuple[float, float, float, float] | None:
        if extent is not None and not (extent[0] < extent[2] and extent[1] < extent[3]):
            raise ValueError("x0, y0, x1, y1 with x0 < x1 and y0 < y1")
        return extent


class CellsConfig(Settings):
    """Recording of the pose cells."""

    chosen: Annotated[Number | Positions, Discriminator(_form)] = 64
    """Cells whose activity is recorded at every step: their number, drawn from the whole network by
    `session.seed`; or the indices x, y, heading of each."""
    sums: CellSumsConfig | None = None
    """Sums of the activity of all cells; null: none."""
