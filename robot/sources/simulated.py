"""A session that was simulated before anybody asks for it, as a source: rows that are all known."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Any, Self

import numpy as np

from robot.sources.input_files import digest_of
from robot.sources.source import Sample
from tactile.base.se2 import wrap
from tactile.base.types import Cycle, Odometry, Report, Whisk

NO_ODOMETRY = Odometry(0.0, 0.0, 0.0, 0.0)
"""Of a reading that does not know its own yet."""


class SimulatedSource(ABC):
    """The part of a `Source` that every simulated session of N rows has; its simulator is the rest.

    Attributes:
        time: [N] s. truth: [N, 3] m, m, rad. odometry: [N, 4] of each row, as `tactile.base.types.Odometry`.
    """

    time: np.ndarray
    truth: np.ndarray
    odometry: np.ndarray

    @abstractmethod
    def _readings(self) -> Iterator[Cycle | Whisk | Report]:
        """What whiskers felt in each row; its odometry is not looked at."""

    @property
    def length(self) -> int:
        return len(self.time)

    def __iter__(self) -> Iterator[Sample]:
        rows = zip(self.time.tolist(), self.odometry, self.truth, self._readings(), strict=True)
        for time, motion, truth, reading in rows:
            yield Sample(time, reading._replace(odometry=Odometry(*motion)), truth.copy())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None  # nothing is open


def wrap_headings(pose: np.ndarray) -> np.ndarray:
    """[N, 3] poses as truth is told: the heading wrapped."""
    return np.column_stack([pose[:, :2], wrap(pose[:, 2])])


def digest_of_document(document: Mapping[str, Any]) -> str:
    """sha256 (hex) of all that a session was made from, which JSON can hold."""
    return digest_of([json.dumps(document, sort_keys=True).encode()])
