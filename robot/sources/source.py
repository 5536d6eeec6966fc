"""The interface of every recording, simulator and live robot, `Source`, and its samples.

`SourceInfo` holds the facts about a source: devices, world and origin. `SourceDescription` describes readings
that the caller brings, such as those of a robot or a simulator of one's own. `SOURCES` has the sources and
recording formats of other packages.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Annotated, Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
from pydantic import Field, NonNegativeInt, PlainSerializer, PlainValidator, PositiveFloat

from tactile.base.bounded import SPOILT, reason
from tactile.base.errors import InputError
from tactile.base.plugins import Registry
from tactile.base.settings import Settings
from tactile.calibration import Calibration
from tactile.pokes import PokeConfig, ring_time
from tactile.whisker_geometry import HeadConfig


def _read_calibration(value: Any) -> Calibration | None:
    if value is None or isinstance(value, Calibration):
        return value
    try:
        return Calibration.from_json(value)
    except TypeError as error:
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
    pokes: PokeConfig | None = None
    """Pokes of an arm without a whisker head."""
    drives: bool = False
    """Whether it is a robot on wheels that touches; one with `planar_whiskers` is one too."""
    cell_size: PositiveFloat | None = None
    """Pose-cell side length that suits the data, m."""
    head: HeadConfig | None = None
    """The whisker head."""
    calibration: Annotated[
        Calibration | None, PlainValidator(_read_calibration), PlainSerializer(lambda c: c and c.to_json())
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
    `rat_simulation`, `live`), `views`: settings that made the views of a live session, or `parameters` of a
    recording. Its reader validates it."""

    @property
    def interval(self) -> float:
        """Usual duration of a step where it is longer than that of other robots, s; else 0."""
        return ring_time(self.pokes) if self.pokes else 0.0

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


class Sample(NamedTuple):
    """One step of a source.

    Attributes:
        time: s, on the source's own clock; never decreases.
        reading: sensor data: an `Observation`, or touch that a front end turns into one: raw samples
            (`Cycle`), contact features (`Whisk`), a motion of the Create (`Report`), or whatever a registered
            front end takes.
        truth: [3] true pose (x m, y m, heading rad), or None where unknown. It is kept apart from the
            reading so that no backend can use it.
    """

    time: float
    reading: Any
    truth: np.ndarray | None


@runtime_checkable
class Source(Protocol):
    """An iterable context manager. A recording can be iterated several times, a live robot once.

    Attributes:
        name: short name for reports.
        rate_hz: median number of samples per second; 0 if unknown.
        view_shape: (R, C, K) of every view, seen or masked.
        whiskers: W, 0 for cameras, lasers and given labels.
        length: number of samples; None if not known in advance.
        digest: sha256 (hex) of all input, which identifies it in a run directory; '' for a live robot.
        info: devices, world and origin.
    """

    @property
    def name(self) -> str: ...
    @property
    def rate_hz(self) -> float: ...
    @property
    def view_shape(self) -> tuple[int, int, int]: ...
    @property
    def whiskers(self) -> int: ...
    @property
    def length(self) -> int | None: ...
    @property
    def digest(self) -> str: ...
    @property
    def info(self) -> SourceInfo: ...
    def __iter__(self) -> Iterator[Sample]: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class ClosedSource:
    """Base class of sources that keep nothing open: a context manager without effect."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass


def rate_of(time: np.ndarray) -> float:
    """Median rate of times [N] s, Hz; 0 with fewer than two different times."""
    steps = np.diff(time)
    steps = steps[steps > 0]
    return float(1.0 / np.median(steps)) if len(steps) else 0.0


@dataclass(frozen=True)
class SourceDescription(ClosedSource):
    """A `Source` without samples: it only says what the readings are like.

    Attributes:
        view_shape: (R, C, K) of every view, seen or masked.
        whiskers: W, 0 for cameras, lasers and given labels.
        rate_hz: readings per second; 0 if unknown.
        info: devices, world and origin. name: short name for reports.

    Raises:
        InputError: a size is not positive, or the number of whiskers or the rate is negative.
    """

    view_shape: tuple[int, int, int]
    whiskers: int = 0
    rate_hz: float = 0.0
    info: SourceInfo = field(default_factory=SourceInfo)
    name: str = "readings"
    length: ClassVar[int | None] = None
    digest: ClassVar[str] = ""

    def __post_init__(self) -> None:
        if len(self.view_shape) != 3 or min(self.view_shape) < 1:
            found = f"the view shape {tuple(self.view_shape)}"
            raise InputError("view_shape", found, "rows, columns and channels of at least 1")
        if self.whiskers < 0 or not self.rate_hz >= 0:
            raise InputError("whiskers, rate_hz", f"{self.whiskers}, {self.rate_hz}", "numbers from 0 on")

    def __iter__(self) -> Iterator[Sample]:
        return iter(())

    def to_json(self) -> str:
        """The description as a JSON document."""
        content = {"view_shape": self.view_shape, "whiskers": self.whiskers, "rate_hz": self.rate_hz}
        return json.dumps(content | {"name": self.name, "info": json.loads(self.info.to_json())})

    @classmethod
    def from_json(cls, text: str) -> SourceDescription:
        """Raises `ValueError` for text that `to_json` cannot have written."""
        try:
            content = json.loads(text)
            rows, columns, channels = content.pop("view_shape")
            info = SourceInfo.model_validate(content.pop("info"))
            return cls(view_shape=(rows, columns, channels), info=info, **content)
        except SPOILT as error:
            raise ValueError(f"not a description of a source ({reason(error)})") from None


def describe(source: Source) -> SourceDescription:
    """The description of a source."""
    return SourceDescription(source.view_shape, source.whiskers, source.rate_hz, source.info, source.name)


Warn = Callable[[str], None] | None


class SourceEntry(NamedTuple):
    """A registered source.

    Attributes:
        config_class: its settings; relative paths in them start at the folder of the configuration. A
            recording format has a setting `file`.
        open: opens the source of these settings; the second argument is called with one sentence if only a
            part of it is readable.
        suffixes: of the files that `recording.file` reads with it, for example ('.bag',).
    """

    config_class: type[Settings]
    open: Callable[[Any, Warn], Source]
    suffixes: tuple[str, ...] = ()


SOURCES: Registry[SourceEntry] = Registry("ratslam.sources", "source", SourceEntry, {})
"""Sources by the name in `source.plugin`."""
