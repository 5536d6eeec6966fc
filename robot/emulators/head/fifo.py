"""Queue of frames, with exact counts of lost frames."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence


class Fifo:
    """A bounded queue; frames made while it is full are lost.

    Attributes:
        made, sent, lost, dropped: number of frames pushed, completely read, lost because the queue was full,
            and dropped by `clear`; made = sent + lost + dropped + len(fifo).
        overran: whether the newest frame was lost.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.made = self.sent = self.lost = self.dropped = 0
        self.overran = False
        self._frames: deque[bytes] = deque()
        self._begun = b""  # the unread rest of a partly read frame

    def __len__(self) -> int:
        """Number of frames in the queue."""
        return len(self._frames) + bool(self._begun)

    @property
    def room(self) -> int:
        """Number of frames that still fit."""
        return self.capacity - len(self)

    def push(self, frames: Sequence[bytes]) -> None:
        """Adds the first frames that fit."""
        fits = frames[: self.room]
        self._frames.extend(fits)
        self.made += len(frames)
        self.lost += len(frames) - len(fits)
        self.overran = len(fits) < len(frames)

    def take(self, size: int) -> bytes:
        """Removes and returns at most `size` bytes."""
        parts, left = [], size
        while left and (self._begun or self._frames):
            frame = self._begun or self._frames.popleft()
            parts.append(frame[:left])
            self._begun = frame[left:]
            left -= len(parts[-1])
            self.sent += not self._begun
        return b"".join(parts)

    def clear(self) -> None:
        """Drops all frames."""
        self.dropped += len(self)
        self._frames.clear()
        self._begun, self.overran = b"", False
