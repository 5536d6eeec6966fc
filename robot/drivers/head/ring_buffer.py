"""Ring buffer of the newest samples of a head, by sequence number."""

from __future__ import annotations

import threading

import numpy as np

from robot.drivers.head.decoder import Frames
from robot.drivers.head.protocol import CHANNELS

SIZE = 2**16
"""Number of samples: 33 s at 2 kHz."""
EMPTY = -(2**62)


class RingBuffer:
    """The last samples. Any thread may read while another appends; results are copies.

    Args:
        whiskers, channels: of the head. size: number of samples, a power of two.
    """

    def __init__(self, whiskers: int, channels: int = CHANNELS, size: int = SIZE) -> None:
        if size & (size - 1):
            raise ValueError(f"size {size}: must be a power of two")
        self._size = size
        self._sequence = np.full(size, EMPTY, np.int64)
        self._time = np.zeros(size, np.int64)
        self._flags = np.zeros(size, np.uint8)
        self._values = np.zeros((size, whiskers, channels), np.int16)
        self._newest, self._latest, self._arrival = EMPTY, EMPTY, -np.inf
        self._lock = threading.Lock()

    @property
    def newest(self) -> tuple[int, int, float] | None:
        """Highest number, its device time (us) and the last arrival (host time, s); None without samples."""
        with self._lock:
            return None if self._newest == EMPTY else (self._newest, self._latest, self._arrival)

    def append(self, frames: Frames, arrival: float) -> None:
        """Adds frames that arrived at a host time, s; frames older than the ring are ignored."""
        with self._lock:
            if not len(frames.sequence):
                return
            newest = max(self._newest, int(frames.sequence.max()))
            fresh = frames.sequence > newest - self._size
            place = frames.sequence[fresh] % self._size
            self._sequence[place] = frames.sequence[fresh]
            self._time[place] = frames.time[fresh]
            self._flags[place] = frames.flags[fresh]
            self._values[place] = frames.values[fresh]
            self._newest, self._arrival = newest, arrival
            self._latest = int(self._time[newest % self._size])

    def between(self, first: int, last: int) -> Frames:
        """The present frames from `first` to `last`, both included, ordered by sequence number."""
        with self._lock:
            number = np.arange(max(first, self._newest - self._size + 1), min(last, self._newest) + 1)
            return self._at(number[self._sequence[number % self._size] == number] % self._size)

    def _at(self, place: np.ndarray) -> Frames:
        return Frames(self._sequence[place], self._time[place], self._flags[place], self._values[place])
