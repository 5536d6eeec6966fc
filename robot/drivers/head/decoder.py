"""Decodes a head's byte stream into frames, unwraps their numbers, and assembles those of one whisk.

The decoder searches for the magic, waits for the bytes of a frame and checks them. A valid frame is consumed;
after an invalid one the search continues at the next byte. A damaged frame therefore costs no other frame,
the result does not depend on the pieces in which the stream arrives, and

    bytes fed = frame size x (good + duplicates) + skipped_bytes + `pending` (bytes not decided yet)

The 32-bit sequence numbers show new, missing and repeated frames, and restarts of the stream. A whisk becomes
a cycle by the same function live and in replay.
"""

from __future__ import annotations

import zlib
from collections import Counter, deque
from itertools import takewhile
from threading import Lock
from typing import NamedTuple

import numpy as np

from robot.drivers.head.usb_protocol import CHANNELS, MAGIC, VERSION, WRAP, FrameFlag, frame_dtype, to_radians
from tactile.base.types import Cycle, Odometry

LATE = 4096
"""Largest distance of a late frame behind the newest; a head buffers no more frames."""
HALF = WRAP // 2


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
        self._seen = bytearray(LATE)

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
        number, new = np.empty(len(raw), np.int64), np.empty(len(raw), bool)
        for place, each in enumerate(raw.tolist()):
            number[place], new[place] = self._take_one(each)
        return number, new

    def _take_one(self, raw: int) -> tuple[int, bool]:
        """Unwraps a number; returns it and whether to accept it."""
        ahead = (raw - self._highest) % WRAP
        if self._begun and 0 < ahead < HALF:
            number = self._highest + ahead
            for skipped in range(max(self._highest, number - LATE) + 1, number):
                self._seen[skipped % LATE] = False
            self._seen[number % LATE] = True
            self._highest = number
            self._held += 1
            return number, True
        number = self._highest - (self._highest - raw) % WRAP
        if not self._begun or number <= self._highest - LATE:
            self.restart()
            number = raw + (WRAP * (self._highest // WRAP + 1) if self.streams else 0)
            self._seen[number % LATE] = True
            self._first = self._highest = number
            self._held, self._begun = 1, True
            self.streams += 1
            return number, True
        new = number > self._first and not self._seen[number % LATE]
        self._seen[number % LATE] |= new
        self._held += new
        return number, new

    def _lacking(self) -> int:
        return self._highest - self._first + 1 - self._held if self._begun else 0


class Frames(NamedTuple):
    """Samples of a head, in order of arrival.

    Attributes:
        sequence: [N] int64 unique number; modulo 2^32 the number sent (`sequence_numbers`).
        time: [N] int64 device time, us; modulo 2^32 the time sent, within 35 minutes of the previous sample.
        flags: [N] uint8 `FrameFlag`. values: [N, W, C] int16 counts of theta, x and y.
    """

    sequence: np.ndarray
    time: np.ndarray
    flags: np.ndarray
    values: np.ndarray

    @classmethod
    def blank(cls, whiskers: int) -> Frames:
        """No frames of a head with this number of whiskers."""
        nothing = np.zeros(0, np.int64)
        return cls(nothing, nothing, np.zeros(0, np.uint8), np.zeros((0, whiskers, CHANNELS), np.int16))

    def select(self, first: int, last: int) -> Frames:
        """The frames from first to last, both included, ordered by sequence number."""
        rows = np.flatnonzero((self.sequence >= first) & (self.sequence <= last))
        rows = rows[np.argsort(self.sequence[rows], kind="stable")]
        return Frames(*(np.ascontiguousarray(column[rows]) for column in self))


class DecoderCounts(NamedTuple):
    """Counts of a decoder since its construction.

    Attributes:
        good: frames accepted and returned.
        bad: occurrences of the magic without a valid frame: wrong version, shape or CRC.
        missing: numbers between the first and the highest accepted of a stream that were not accepted, summed
            over the streams. Decreases when a frame arrives late.
        skipped_bytes: bytes that belong to no valid frame, counted when they are skipped.
        overruns: accepted frames that report dropped frames before them.
        duplicates: valid frames that were not returned: their number was accepted before, or lies before the
            first of its stream.
        restarts: streams after the first.
    """

    good: int = 0
    bad: int = 0
    missing: int = 0
    skipped_bytes: int = 0
    overruns: int = 0
    duplicates: int = 0
    restarts: int = 0


class Decoder:
    """Decodes the frames of `robot.drivers.head.usb_protocol`. A decoder of another stream needs the members
    `counts`, `feed` and `restart`."""

    def __init__(self, whiskers: int, channels: int = CHANNELS) -> None:
        self._type = frame_dtype(whiskers, channels)
        self._size = self._type.itemsize
        self._shape = bytes((whiskers, channels, VERSION))
        self._shape_at = self._type.fields["whiskers"][1]  # type: ignore[index]
        self._rest = b""
        self._numbering = SequenceUnwrapper()
        self._time: int | None = None
        self._counts = Counter[str]()

    @property
    def counts(self) -> DecoderCounts:
        """Counts so far."""
        restarts = max(0, self._numbering.streams - 1)
        return DecoderCounts(missing=self._numbering.missing, restarts=restarts, **self._counts)

    @property
    def pending(self) -> int:
        """Bytes not decided yet; fewer than a frame."""
        return len(self._rest)

    def restart(self, time: int | None = None) -> None:
        """Starts a new stream; a partial frame is dropped.

        Args:
            time: approximate device clock now, us; None: the time of the next frame starts the stream.
        """
        self._counts["skipped_bytes"] += len(self._rest)
        self._rest = b""
        self._numbering.restart()
        self._time = time

    def feed(self, data: bytes) -> Frames:
        """The samples completed by these bytes."""
        buffer = self._rest + data if self._rest else bytes(data)
        frames: list[bytes] = []
        place = 0
        while 0 <= (start := buffer.find(MAGIC, place)) <= len(buffer) - self._size:
            self._counts["skipped_bytes"] += start - place
            frame = buffer[start : start + self._size]
            shape, crc = frame[self._shape_at : self._shape_at + 3], int.from_bytes(frame[-4:], "little")
            if shape == self._shape and zlib.crc32(frame[:-4]) == crc:
                frames.append(frame)
                place = start + self._size
            else:
                self._counts.update(("bad", "skipped_bytes"))
                place = start + 1
        end = start
        if end < 0:  # the last bytes may be the start of the magic
            tail = buffer[max(place, len(buffer) - 3) :]
            end = len(buffer) - next((k for k in range(len(tail), 0, -1) if tail.endswith(MAGIC[:k])), 0)
        self._counts["skipped_bytes"] += end - place
        self._rest = buffer[end:]
        return self._accept(np.frombuffer(b"".join(frames), self._type))

    def _accept(self, frames: np.ndarray) -> Frames:
        number, new = self._numbering.take(frames["sequence"])
        if not new.all():
            frames, number = frames[new], number[new]
        overruns = int(np.count_nonzero(frames["flags"] & FrameFlag.OVERRUN))
        self._counts.update(good=len(frames), duplicates=len(new) - len(frames), overruns=overruns)
        time = frames["time"].astype(np.int64)
        if len(time):  # unwrapped: each within half of the range of the previous one
            before = int(time[0]) if self._time is None else self._time
            time[1:] -= time[:-1].copy()
            time[0] -= before
            time = before + ((time + HALF) % WRAP - HALF).cumsum()
            self._time = int(time[-1])
        return Frames(number, time, frames["flags"].copy(), frames["values"].copy())


MAX_FRAMES = 1 << 16
"""Number of frames kept for later whisks: half a minute at 2 kHz."""


class Cut(NamedTuple):
    """The frames of a whisk, with its times and odometry.

    Attributes:
        number: of the whisk. time: of its sample, s. start: of the whisk, s, on the same clock.
        first, last: sequence numbers of its first and last frame. frames: number of these that arrived.
        odometry: motion since the previous whisk.
        seen: whether its frames become a reading; False where its image was dropped, which does not affect
            the motion.
    """

    number: int
    time: float
    start: float
    first: int
    last: int
    frames: int
    odometry: Odometry
    seen: bool

    @classmethod
    def of(
        cls, number: int, time: float, start: float, frames: Frames, odometry: Odometry, seen: bool = True
    ) -> Cut:
        """The cut of exactly these frames; not `seen` without frames."""
        count = len(frames.sequence)
        first, last = (int(frames.sequence.min()), int(frames.sequence.max())) if count else (0, -1)
        return cls(number, float(time), float(start), first, last, count, odometry, bool(seen and count))


def assemble_cycle(frames: Frames, cut: Cut) -> Cycle:
    """The whisk as a cycle; without samples if the cut is not `seen`.

    Args:
        frames: the frames of the cut, in any order; others are ignored.

    Raises:
        ValueError: frames of the cut are missing.
    """
    if not cut.seen:
        frames = frames.select(0, -1)
        return Cycle(np.zeros(0), *to_radians(frames.values), cut.odometry)
    mine = frames.select(cut.first, cut.last)
    if len(mine.sequence) != cut.frames:
        raise ValueError(f"a whisk of {cut.frames} frames, of which {len(mine.sequence)} are present")
    # The memory layout matters: it decides the order of summation.
    angle, deflection = (np.ascontiguousarray(part) for part in to_radians(mine.values))
    time = cut.start + (mine.time - mine.time[0]) * 1e-6
    return Cycle(time, angle, deflection, cut.odometry)


class FrameWindow:
    """The most recent frames of a head with this number of whiskers, in blocks as they arrived.

    Any thread may read while another adds; results are copies.

    Attributes:
        newest: highest number, its device time (us) and the last arrival (host time, s); None without frames.
    """

    def __init__(self, whiskers: int) -> None:
        self.newest: tuple[int, int, float] | None = None
        self._empty = Frames.blank(whiskers)
        self._blocks: deque[tuple[int, int, Frames]] = deque()  # lowest and highest number, and the block
        self._count = 0
        self._lock = Lock()

    def add(self, block: Frames, arrival: float = np.nan) -> None:
        """Adds a block that arrived at a host time, s; drops the oldest ones beyond the last `MAX_FRAMES`
        frames."""
        if not len(block.sequence):
            return
        place = int(block.sequence.argmax())
        low, high, time = int(block.sequence.min()), int(block.sequence[place]), int(block.time[place])
        with self._lock:
            before = self.newest or (high, time, arrival)
            self.newest = (*max((high, time), before[:2]), arrival)
            self._blocks.append((low, high, block))
            self._count += len(block.sequence)
            while self._count - len(self._blocks[0][2].sequence) >= MAX_FRAMES:
                self._count -= len(self._blocks.popleft()[2].sequence)

    def between(self, first: int, last: int) -> Frames:
        """The present frames from first to last, both included, ordered by sequence number."""
        with self._lock:  # frames come at most `LATE` out of order, so that the newest blocks are enough
            recent = takewhile(lambda entry: entry[1] >= first - LATE, reversed(self._blocks))
            blocks = [block for low, high, block in recent if low <= last and high >= first]
        parts = zip(*(blocks or [self._empty]), strict=True)
        return Frames(*(np.concatenate(part) for part in parts)).select(first, last)
