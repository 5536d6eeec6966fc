"""Base class of simulated sources, which compute all poses and odometry when they are made."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from robot.sources.input_files import digest_of
from robot.sources.source import ClosedSource, Sample
from tactile.base.errors import InputError
from tactile.base.se2 import wrap
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk

NO_ODOMETRY = Odometry(0.0, 0.0, 0.0, 0.0)
"""Placeholder in a reading until its row's odometry is filled in."""

MOST_STEPS = 1_000_000
"""Longest simulated session, steps: all are computed before the first."""


def check_steps(where: str, steps: float) -> None:
    """Raises `InputError` if a session would be longer than `MOST_STEPS`."""
    if not steps <= MOST_STEPS:
        raise InputError(where, f"{steps:.3g} steps", f"at most {MOST_STEPS}", "a shorter session")


class SimulatedSource(ClosedSource, ABC):
    """A simulated session of N rows; subclasses add the remaining attributes of a `Source`.

    Attributes:
        time: [N] s. truth: [N, 3] m, m, rad. odometry: [N, 4] as in `tactile.base.types.Odometry`.
    """

    time: np.ndarray
    truth: np.ndarray
    odometry: np.ndarray

    @abstractmethod
    def _readings(self) -> Iterator[Cycle | Whisk | Report | Observation]:
        """The reading of each row; its odometry is overwritten."""

    @property
    def length(self) -> int:
        return len(self.time)

    def __iter__(self) -> Iterator[Sample]:
        rows = zip(self.time.tolist(), self.odometry, self.truth, self._readings(), strict=True)
        for time, motion, truth, reading in rows:
            yield Sample(time, reading._replace(odometry=Odometry(*motion)), truth.copy())


def wrap_headings(pose: np.ndarray) -> np.ndarray:
    """Poses [N, 3] with wrapped headings."""
    return np.column_stack([pose[:, :2], wrap(pose[:, 2])])


def digest_of_document(document: Mapping[str, Any]) -> str:
    """SHA-256 (hex) of a JSON document."""
    return digest_of([json.dumps(document, sort_keys=True).encode()])
