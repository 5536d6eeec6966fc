"""A recording held in memory as columns; its samples are made as they are asked for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import repeat
from types import TracebackType
from typing import Self

import numpy as np

from robot.source import Sample, rate_of
from tactile.types import Odometry, observation


@dataclass(frozen=True, eq=False)
class Log:
    """A `Source` over N rows of observations without contacts.

    Attributes:
        time: [N] s. motion: [N, 4] (dx m, dy m, dtheta rad, dt s) since the row before.
        moved: [N] whether the row carries odometry (else its motion is zero).
        views: [N, R, C, K] in 0..1, zero where not seen. seen: [N] whether there is a view.
        label: [N] given place id, -1 for none.
        truth: [N, 3] (x m, y m, heading rad), a row of NaN where unknown; None when nowhere known.
        params: what the recording says about itself, for whoever wants to reproduce a run on it.
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
    params: Mapping[str, float | int | str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.views.flags.writeable = False  # samples hand out slices of it

    @property
    def rate_hz(self) -> float:
        return rate_of(self.time[self.moved])

    @property
    def view_shape(self) -> tuple[int, int, int]:
        rows, columns, channels = self.views.shape[1:]
        return rows, columns, channels

    @property
    def whiskers(self) -> int:
        return 0

    @property
    def length(self) -> int:
        return len(self.time)

    def __iter__(self) -> Iterator[Sample]:
        shape = self.view_shape
        for time, motion, view, seen, label, truth in zip(
            self.time.tolist(), self.motion, self.views, self.seen, self.label, self._truths(), strict=True
        ):
            picture = view if seen else None
            yield Sample(time, observation(Odometry(*motion), picture, view_shape=shape, label=label), truth)

    def _truths(self) -> Iterator[np.ndarray | None]:
        if self.truth is None:
            yield from repeat(None, self.length)
        else:
            yield from (None if np.isnan(truth).any() else truth.copy() for truth in self.truth)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass
