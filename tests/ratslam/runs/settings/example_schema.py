"""Settings of an example, a file that sets every part of them, and what is said of other files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import Field, model_validator

from ratslam.runs.settings.strict_yaml import override, parse, validate
from tactile.base.errors import InputError
from tactile.base.settings import Settings


class PoseCells(Settings):
    """A section."""

    excite_sigma: float = Field(1.0, gt=0)
    """Width of the excitation, cells."""
    shape: tuple[int, int, int] = (21, 21, 36)
    """Cells along x, y and heading."""

    @model_validator(mode="after")
    def _odd(self) -> PoseCells:
        if self.shape[0] % 2 == 0 and self.shape[1] % 2 == 0:
            raise ValueError("one of x and y must be odd")
        return self


class Recording(Settings):
    """One alternative of a union."""

    kind: Literal["recording", "bag"] = "recording"
    path: Path
    """The file of the recording."""


class Simulation(Settings):
    """The other alternative."""

    kind: Literal["simulation"] = "simulation"
    simulation: int = 0
    """A field named as the union's tag."""


Source = Annotated[Recording | Simulation, Field(discriminator="kind")]


class Config(Settings):
    """A whole configuration."""

    pose_cells: PoseCells = PoseCells()
    metric: Literal["l1", "cosine"] = "l1"
    motion: Literal["forward", "turn"] = "forward"
    source: Source = Simulation()
    others: tuple[Source, ...] = ()
    optional: PoseCells | None = None
    width: float | tuple[float, float] = 1.0
    gains: dict[str, float] = Field(default_factory=dict)
    learn: bool = True
    steps: int = Field(10, ge=0)
    name: str = Field("run", max_length=1000)
    weights: tuple[float, ...] = Field((), max_length=50)


VALID = """\
# every part once
pose_cells:
  excite_sigma: 1e-3
  shape: [21, 21, 36]
metric: cosine
source:
  kind: recording
  path: "data/a.mcap"
others:
- kind: simulation
  simulation: 3
- {kind: bag, path: b.bag}
optional:
width: [1.5, .5]
gains: {left: 1, right: -2.5e+2}
learn: false
name: off
"""


def overridden(*assignments: str, text: str = VALID) -> Config:
    return validate(override(parse(text, "config.yaml"), assignments), Config)


def refusal(text: str) -> str:
    """The message for a text that cannot be read or is not a `Config`."""
    with pytest.raises(InputError) as caught:
        validate(parse(text, "config.yaml"), Config)
    return str(caught.value)
