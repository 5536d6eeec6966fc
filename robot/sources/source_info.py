"""Facts about a source: devices, world and origin, as one typed record."""

from __future__ import annotations

import json
from typing import Annotated, Any

import numpy as np
from pydantic import Field, NonNegativeInt, PlainSerializer, PlainValidator, PositiveFloat

from tactile.base.bounded import SPOILT, reason
from tactile.base.settings import Settings
from tactile.features.calibration import Calibration, calibration_from_arrays, calibration_json
from tactile.whiskers.head_geometry import HeadConfig


def _read_calibration(value: Any) -> Calibration | None:
    if value is None or isinstance(value, Calibration):
        return value
    try:
        kinds = {name: bool if name == "alive" else float for name in value}
        arrays = {name: np.asarray(array, kinds[name]) for name, array in value.items()}
        return calibration_from_arrays(arrays)
    except (AttributeError, TypeError) as error:
        raise ValueError(f"not a calibration: {error}") from None


class MazeInfo(Settings):
    """The maze of a session on a whisker head."""

    text: str
    """Drawing of the maze, in the format of a maze file."""
    heights: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)]
    """Wall heights to draw from, m."""
    seed: NonNegativeInt
    """Seed of the wall heights."""


class PlanarWhiskersInfo(Settings):
    """The fixed whiskers of a Create."""

    mounts: Annotated[tuple[tuple[float, float, float], ...], Field(min_length=1)]
    """For each whisker the position of its base in base_link, x (m) and y (m), and its direction (degrees
    counter-clockwise from ahead)."""
    length: PositiveFloat
    """Length of a whisker, m."""


class SimulationInfo(Settings):
    """Simulation of a session on a whisker head."""

    sha256: str
    """Hash (hex) of the generating configuration."""
    seed: NonNegativeInt
    """Seed of all its random streams."""
    tier: str
    """Fidelity: kinematic, quasistatic or dynamic."""
    why: str
    """Reason for this fidelity."""


class SourceInfo(Settings):
    """Facts about a source that consumers rely on; a recording stores them as one JSON document."""

    raw_whiskers: bool = False
    """Whether some readings are whisker data (`Cycle`, `Whisk`, `Report`), which a touch front end must turn
    into observations."""
    labels_only: bool = False
    """Whether readings carry given place labels and never a view."""
    signed_views: bool = False
    """Whether views are signed departures from rest, in any unit, instead of values in 0..1."""
    cell_size: PositiveFloat | None = None
    """Pose-cell side length that suits the data, m."""
    head: HeadConfig | None = None
    """The whisker head."""
    calibration: Annotated[
        Calibration | None,
        PlainValidator(_read_calibration),
        PlainSerializer(lambda c: c and calibration_json(c)),
    ] = None
    """Free-whisking calibration of the head."""
    planar_whiskers: PlanarWhiskersInfo | None = None
    """Whiskers of a Create, whose readings are `Report`s."""
    maze: MazeInfo | None = None
    """The maze that surrounds a whisker head."""
    arena: str | None = None
    """The arena of a Create, in the format of an arena file."""
    simulation: SimulationInfo | None = None
    """Set if a session on a whisker head was simulated."""
    box: tuple[float, float, float, float] | None = None
    """Extent of the box in the frame of the truth: x0, y0, x1, y1, m; of the largest if there are several."""
    provenance: dict[str, Any] = Field(default_factory=dict)
    """Generating configuration under its key in a run configuration (`simulation`, `create_simulation`,
    `rat_simulation`, `live`), or `parameters` of a recording. Its reader validates it."""

    def to_json(self) -> str:
        """The record as a JSON document with sorted keys.

        Raises:
            TypeError, ValueError: a value in `provenance` is not JSON, or a number in it is not finite.
        """
        return json.dumps(self.model_dump(), allow_nan=False, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> SourceInfo:
        """Raises `ValueError` for text that `to_json` cannot have written."""
        try:
            return cls.model_validate(json.loads(text))
        except SPOILT as error:
            raise ValueError(f"not a description of a source ({reason(error)})") from None

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SourceInfo) and self.to_json() == other.to_json()  # arrays compare by value
