"""Strain of the whiskers from the samples of a head: the rows that the state machine monitors, and series."""

from __future__ import annotations

import numpy as np

from robot.drivers.head.decoder import Frames
from robot.drivers.head.protocol import to_radians

MAX_ROWS = 2**16
"""Rows that are kept of a motion; later ones are ignored."""


class StrainMonitor:
    """Averages samples over the period of the state machine; counts samples, not the host's time.

    Args:
        rate: samples per second. period: of a row, s. strain_per_radian: of the sensors. whiskers: W.

    Attributes:
        rest: [W, 2] strain at rest, subtracted from all others. first: number of the first sample of the
            motion.
    """

    def __init__(self, rate: float, period: float, strain_per_radian: float, whiskers: int) -> None:
        self.rate, self.samples = rate, max(round(rate * period), 1)
        self.rest = np.zeros((whiskers, 2))
        self.first = 0
        self._scale = strain_per_radian
        self._sum = np.zeros((64, whiskers, 2))
        self._count = np.zeros(64, np.int64)
        self._newest: int | None = None

    def begin(self) -> None:
        """Starts a motion with the next sample."""
        self.first = 0 if self._newest is None else self._newest + 1
        self._sum[:], self._count[:] = 0.0, 0

    def restart(self) -> None:
        """Starts with the next sample, of any number: the head was connected."""
        self._newest = None
        self.begin()

    def add(self, frames: Frames) -> None:
        """Adds samples; those before the motion are ignored."""
        if self._newest is None:
            self.first = int(frames.sequence.min())
            self._newest = self.first - 1
        self._newest = max(self._newest, int(frames.sequence.max()))
        place = (frames.sequence - self.first) // self.samples
        mine = (place >= 0) & (place < MAX_ROWS)
        if not mine.any():
            return
        self._reserve(int(place[mine].max()) + 1)
        np.add.at(self._sum, place[mine], self.strain(frames.values[mine]))
        np.add.at(self._count, place[mine], 1)

    def strain(self, values: np.ndarray) -> np.ndarray:
        """Strain [N, W, 2], horizontal and vertical, of the values of samples."""
        return to_radians(values)[1] * self._scale - self.rest

    def rows(self, most: int) -> np.ndarray:
        """Mean strain [T, W, 2] of the complete periods of the motion, at most the first `most`.

        A period of which all samples were lost repeats the one before.
        """
        passed = 0 if self._newest is None else (self._newest + 1 - self.first) // self.samples
        whole = min(passed, len(self._count), most)
        count = self._count[:whole]
        mean = self._sum[:whole] / np.maximum(count, 1)[:, None, None]
        known = np.maximum.accumulate(np.where(count > 0, np.arange(whole), 0))
        return mean[known]

    def last_sample(self, rows: int) -> int:
        """Number of the last sample of the first `rows` periods."""
        return self.first + rows * self.samples - 1

    def series(self, frames: Frames, rows: int, gap: int) -> np.ndarray:
        """Strain [T, W, 2] of every sample of the first `rows` periods; lost ones are interpolated.

        Args:
            frames: the present ones. gap: number of consecutive lost samples that makes the series unusable;
                it is then empty.
        """
        wanted = np.arange(self.first, self.last_sample(rows) + 1)
        strain = self.strain(frames.values)
        if len(frames.sequence) == len(wanted):
            return strain
        edges = np.concatenate([[wanted[0] - 1], frames.sequence, [wanted[-1] + 1]])
        if np.diff(edges).max() > gap:
            return strain[:0]
        flat = strain.reshape(len(strain), -1).T
        filled = np.stack([np.interp(wanted, frames.sequence, channel) for channel in flat], axis=1)
        return filled.reshape(len(wanted), *strain.shape[1:])

    def _reserve(self, rows: int) -> None:
        """Makes room for this many rows."""
        while len(self._count) < rows:
            self._sum = np.concatenate([self._sum, np.zeros_like(self._sum)])
            self._count = np.concatenate([self._count, np.zeros_like(self._count)])
