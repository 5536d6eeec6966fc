"""Unwraps 32-bit sequence numbers; finds new, missing and repeated frames and restarts of the stream."""

from __future__ import annotations

import numpy as np

from robot.drivers.head.usb_protocol import WRAP

LATE = 4096
"""Largest distance of a late frame behind the newest; a head buffers no more frames."""
HALF = WRAP // 2
BATCH = 1024
"""Numbers processed at once."""


class SequenceUnwrapper:
    """The numbers of the frames accepted so far.

    A number less than `HALF` above the highest is ahead; one less than `LATE` below it is late; a lower one
    means that the head has restarted its count, and a new stream begins. Its numbers continue in the next
    2^32, so that all numbers are unique.
    """

    def __init__(self) -> None:
        self.streams = 0
        """Number of streams."""
        self._begun = False
        self._first = self._highest = self._held = 0
        self._before = 0
        self._seen = np.zeros(LATE, bool)

    @property
    def missing(self) -> int:
        """Numbers between the first and the highest accepted of a stream that were not accepted."""
        return self._before + self._lacking()

    def restart(self) -> None:
        """Starts a new stream with the next frame."""
        self._before += self._lacking()
        self._begun = False

    def take(self, raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unwraps raw numbers [N], in order of arrival.

        Returns:
            [N] int64 unwrapped numbers, and [N] bool, those to accept: new, and not before the first of the
            stream.
        """
        raw = raw.astype(np.int64)
        number, new = np.empty_like(raw), np.ones(len(raw), bool)
        place = 0
        while place < len(raw):
            some = slice(place, place + self._rising(raw[place : place + BATCH]))
            if some.stop > place:
                number[some] = self._highest + (raw[some] - self._highest) % WRAP
                self._ahead(number[some])
                place = some.stop
            else:
                number[place], new[place] = self._other(int(raw[place]))
                place += 1
        return number, new

    def _rising(self, raw: np.ndarray) -> int:
        """Length of the leading part of numbers [N] in which each is ahead of the previous one."""
        if not self._begun:
            return 0
        ahead = (raw - self._highest) % WRAP
        rising = ahead < HALF
        rising[0] &= ahead[0] > 0
        rising[1:] &= ahead[1:] > ahead[:-1]
        return len(raw) if rising.all() else int(rising.argmin())

    def _other(self, raw: int) -> tuple[int, bool]:
        """Unwraps a number that is not ahead; returns it and whether to accept it."""
        number = self._highest - (self._highest - raw) % WRAP
        if not self._begun or number <= self._highest - LATE:
            self.restart()
            return self._begin(raw), True
        new = number > self._first and not self._seen[number % LATE]
        self._seen[number % LATE] |= new
        self._held += new
        return number, bool(new)

    def _begin(self, raw: int) -> int:
        number = raw + (WRAP * (self._highest // WRAP + 1) if self.streams else 0)
        self._seen[number % LATE] = True
        self._first = self._highest = number
        self._held, self._begun = 1, True
        self.streams += 1
        return number

    def _ahead(self, number: np.ndarray) -> None:
        """Accepts increasing numbers, all above the highest."""
        last = int(number[-1])
        self._seen[np.arange(max(self._highest, last - LATE) + 1, last + 1) % LATE] = False
        self._seen[number[number > last - LATE] % LATE] = True
        self._highest = last
        self._held += len(number)

    def _lacking(self) -> int:
        return self._highest - self._first + 1 - self._held if self._begun else 0
