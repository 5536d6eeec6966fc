"""What every recording, simulator and live robot looks like from outside."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np

from tactile.base.types import Cycle, Observation, Report, Whisk


class Sample(NamedTuple):
    """One step of a source.

    Attributes:
        time: s, on the source's own clock; never goes back.
        reading: what the robot sensed: an `Observation`, or whiskers, raw (`Cycle`), felt (`Whisk`) or of a
            state machine (`Report`), of which the sense of touch makes one.
        truth: [3] where the robot really was (x m, y m, heading rad), or None where that is unknown.
            It travels beside the reading, never inside, so no engine can peek.
    """

    time: float
    reading: Observation | Cycle | Whisk | Report
    truth: np.ndarray | None


@runtime_checkable
class Source(Protocol):
    """A context manager to iterate over. A recording may be iterated again, a live robot only once.

    Attributes:
        name: short name for reports.
        rate_hz: median number of samples per second; 0 where it is unknown.
        view_shape: (R, C, K) of every view, seen or masked.
        whiskers: W, 0 for cameras, lasers and given labels.
        length: number of samples; None where nobody knows yet.
        digest: sha256 (hex) of everything read, so that a run can name its input; '' for a live robot.
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
    def __iter__(self) -> Iterator[Sample]: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


@runtime_checkable
class Rigged(Source, Protocol):
    """A source that knows by what it was made.

    Attributes:
        rig: a JSON document: the head's configuration, the simulation's, calibrations; {} where unknown.
        whisked: whether readings are whiskers, which have no view yet.
    """

    @property
    def rig(self) -> Mapping[str, Any]: ...
    @property
    def whisked(self) -> bool: ...


def rig_of(source: Source) -> Mapping[str, Any]:
    """By what a source was made; {} where it does not know."""
    return source.rig if isinstance(source, Rigged) else {}


def rate_of(time: np.ndarray) -> float:
    """Median rate of the times [N] s, Hz; 0 where there are fewer than two different ones."""
    steps = np.diff(time)
    steps = steps[steps > 0]
    return float(1.0 / np.median(steps)) if len(steps) else 0.0
