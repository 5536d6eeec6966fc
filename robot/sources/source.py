"""The interface of every recording, simulator and live robot."""

from __future__ import annotations

from collections.abc import Iterator
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np

from robot.sources.source_info import SourceInfo


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
