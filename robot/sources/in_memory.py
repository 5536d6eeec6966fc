"""Sources held in memory as columns; samples are built during iteration.

`SimulatedSource` is the base class of simulations, which compute all poses and odometry when they are made.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from robot.sources.input_files import digest_of
from robot.sources.source import ClosedSource, Sample, Source, SourceInfo, rate_of
from tactile.base.errors import InputError
from tactile.base.se2 import wrap
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk, observation


@dataclass(frozen=True, eq=False)
class InMemorySource(ClosedSource):
    """A `Source` over N rows of observations without walls.

    Attributes:
        time: [N] s. motion: [N, 4] (dx m, dy m, dtheta rad, dt s) since the previous row.
        moved: [N] whether the row has odometry (otherwise its motion is zero).
        views: [N, R, C, K] in 0..1, zero without a view. seen: [N] whether there is a view.
        label: [N] given place label, -1 for none.
        truth: [N, 3] (x m, y m, heading rad), rows of NaN where unknown; None if never known.
        info: devices, world and origin.
        alive: [W] or [N, W] whether each whisker works; empty for cameras, lasers and given labels.
        contact: [N, W] bool, whiskers in contact, and point: [N, W, 2] contact points in base_link, m, zero
            without contact; None for a source without contacts.
    """

    name: str
    digest: str
    time: np.ndarray
    motion: np.ndarray
    moved: np.ndarray
    views: np.ndarray
    seen: np.ndarray
    label: np.ndarray
    truth: np.ndarray | None = None
    info: SourceInfo = field(default_factory=SourceInfo)
    alive: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    contact: np.ndarray | None = None
    point: np.ndarray | None = None

    def __post_init__(self) -> None:
        self.views.flags.writeable = False  # samples share slices of it

    @property
    def rate_hz(self) -> float:
        return rate_of(self.time[self.moved])

    @property
    def view_shape(self) -> tuple[int, int, int]:
        rows, columns, channels = self.views.shape[1:]
        return rows, columns, channels

    @property
    def whiskers(self) -> int:
        return self.alive.shape[-1]

    @property
    def length(self) -> int:
        return len(self.time)

    def __iter__(self) -> Iterator[Sample]:
        shape, count = self.view_shape, self.whiskers
        alive = np.broadcast_to(self.alive, (self.length, count))
        columns = (self.time.tolist(), self.motion, self.views, self.seen, self.label)
        for row, (time, motion, view, seen, label) in enumerate(zip(*columns, strict=True)):
            picture = view if seen else None
            reading = observation(Odometry(*motion), picture, view_shape=shape, label=label, whiskers=count)
            reading = reading._replace(alive=alive[row].copy())
            if self.contact is not None and self.point is not None:
                reading = reading._replace(contact=self.contact[row].copy(), point=self.point[row].copy())
            known = self.truth is not None and not np.isnan(self.truth[row]).any()
            yield Sample(time, reading, self.truth[row].copy() if self.truth is not None and known else None)


def load_into_memory(source: Source) -> InMemorySource:
    """A source of observations, read into memory; contact points are not kept.

    Raises:
        InputError: some readings are whisker data, or there are no samples.
    """
    samples = list(source)
    readings = [sample.reading for sample in samples if isinstance(sample.reading, Observation)]
    if len(readings) < len(samples) or not samples:
        raise InputError(source.name, "whisker readings" if samples else "no samples", "observations")
    unknown = np.full(3, np.nan)
    truth = np.array([unknown if sample.truth is None else sample.truth for sample in samples])
    return InMemorySource(
        name=source.name,
        digest=source.digest,
        time=np.array([sample.time for sample in samples]),
        motion=np.array([[*reading.odometry] for reading in readings], float),
        moved=np.ones(len(samples), bool),
        views=np.array([reading.view for reading in readings]),
        seen=np.array([reading.view_seen for reading in readings]),
        label=np.array([reading.label for reading in readings], np.int32),
        truth=None if np.isnan(truth).all() else truth,
        info=source.info.model_copy(update={"raw_whiskers": False}),
        alive=np.array([reading.alive for reading in readings], bool),
    )


def truncate_log(log: InMemorySource, steps: int) -> InMemorySource:
    """The first steps of a source in memory; its digest is the original one followed by their number."""
    return replace(select_rows(log, np.arange(log.length)[:steps]), digest=f"{log.digest}[:{steps}]")


def cut_log(log: InMemorySource, first: int, last: int | None = None) -> InMemorySource:
    """The steps from `first` up to but without `last` (None: to the end) as a session of their own.

    Its first step has no motion; its digest is the original one followed by these numbers.
    """
    last = log.length if last is None else min(last, log.length)
    part = select_rows(log, np.arange(first, last))
    part.motion[:1] = 0.0  # a copy: rows are chosen by number
    return replace(part, digest=f"{log.digest}[{first}:{last}]")


def select_rows(log: InMemorySource, rows: np.ndarray) -> InMemorySource:
    """The rows of a source in memory with these numbers [n]; motions stay as they are, and so does the
    digest."""
    columns = ["time", "motion", "moved", "views", "seen", "label", "truth", "contact", "point"]
    columns += ["alive"] * (log.alive.ndim == 2)
    chosen = {name: getattr(log, name)[rows] for name in columns if getattr(log, name) is not None}
    return replace(log, **chosen)


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
