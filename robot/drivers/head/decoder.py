"""Decodes a head's byte stream into frames, also after damage, loss or insertion of bytes.

The decoder searches for the magic, waits for the bytes of a frame and checks them. A valid frame is consumed;
after an invalid one the search continues at the next byte. A damaged frame therefore costs no other frame,
the result does not depend on the pieces in which the stream arrives, and

    bytes fed = frame size x (good + duplicates) + skipped_bytes + `pending` (bytes not decided yet)
"""

from __future__ import annotations

import zlib
from typing import NamedTuple, Protocol

import numpy as np

from robot.drivers.head.sequence_numbers import HALF, SequenceUnwrapper
from robot.drivers.head.usb_protocol import CHANNELS, MAGIC, VERSION, WRAP, FrameFlag, frame_dtype

BATCH, MAX_BATCH = 32, 1024
"""Frames checked at once: the first number after a fault, doubled after every batch without one."""


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


class FrameDecoder(Protocol):
    """Interface of a decoder of a bridge's stream."""

    @property
    def counts(self) -> DecoderCounts:
        """Counts so far."""
        ...

    def feed(self, data: bytes) -> Frames:
        """The samples completed by these bytes."""
        ...

    def restart(self, time: int | None = None) -> None:
        """Starts a new stream; a partial frame is dropped.

        Args:
            time: approximate device clock now, us; None: the time of the next frame starts the stream.
        """
        ...


class Decoder:
    """Decodes the frames of `robot.drivers.head.usb_protocol`.

    Args:
        whiskers: number on the head. channels: per whisker.
    """

    def __init__(self, whiskers: int, channels: int = CHANNELS) -> None:
        self._type = frame_dtype(whiskers, channels)
        self._size = self._type.itemsize
        self._shape = bytes((whiskers, channels, VERSION))
        self._shape_at = self._type.fields["whiskers"][1]  # type: ignore[index]
        self._magic = int.from_bytes(MAGIC, "little")
        self._rest = b""
        self._run = BATCH
        self._numbering = SequenceUnwrapper()
        self._time: int | None = None
        self._good = self._bad = self._skipped = self._overruns = self._duplicates = 0

    @property
    def counts(self) -> DecoderCounts:
        return DecoderCounts(
            good=self._good,
            bad=self._bad,
            missing=self._numbering.missing,
            skipped_bytes=self._skipped,
            overruns=self._overruns,
            duplicates=self._duplicates,
            restarts=max(0, self._numbering.streams - 1),
        )

    @property
    def pending(self) -> int:
        """Bytes not decided yet; fewer than a frame."""
        return len(self._rest)

    def restart(self, time: int | None = None) -> None:
        self._skipped += len(self._rest)
        self._rest = b""
        self._numbering.restart()
        self._time = time

    def feed(self, data: bytes) -> Frames:
        buffer = self._rest + data if self._rest else bytes(data)
        runs: list[bytes] = []
        place = 0
        while 0 <= (start := buffer.find(MAGIC, place)) <= len(buffer) - self._size:
            self._skipped += start - place
            place = start + self._count_valid(buffer, start) * self._size
            if place > start:
                runs.append(buffer[start:place])
            else:
                self._bad += 1
                self._skipped += 1
                place += 1
        end = start if start >= 0 else len(buffer) - _partial_magic(buffer[max(place, len(buffer) - 3) :])
        self._skipped += end - place
        self._rest = buffer[end:]
        return self._accept(np.frombuffer(b"".join(runs), self._type))

    def _count_valid(self, buffer: bytes, start: int) -> int:
        """Number of consecutive valid frames from `start` in the batch checked at once."""
        shape_at = start + self._shape_at
        if buffer[shape_at : shape_at + 3] != self._shape:
            return 0
        count = min((len(buffer) - start) // self._size, self._run)
        frames = np.frombuffer(buffer, self._type, count, start)
        whiskers, channels, version = self._shape
        fits = (frames["magic"] == self._magic) & (frames["version"] == version)
        fits &= (frames["whiskers"] == whiskers) & (frames["channels"] == channels)
        body, raw = self._size - 4, memoryview(buffer)
        whole = 0
        for crc in frames["crc"][: count if fits.all() else int(fits.argmin())].tolist():
            place = start + whole * self._size
            if zlib.crc32(raw[place : place + body]) != crc:
                break
            whole += 1
        self._run = min(2 * self._run, MAX_BATCH) if whole == count else BATCH
        return whole

    def _accept(self, frames: np.ndarray) -> Frames:
        number, new = self._numbering.take(frames["sequence"])
        if not new.all():
            frames, number = frames[new], number[new]
        self._good += len(frames)
        self._duplicates += len(new) - len(frames)
        self._overruns += int(np.count_nonzero(frames["flags"] & FrameFlag.OVERRUN))
        return Frames(
            number, self._unwrap_times(frames["time"]), frames["flags"].copy(), frames["values"].copy()
        )

    def _unwrap_times(self, raw: np.ndarray) -> np.ndarray:
        time = raw.astype(np.int64)
        if len(time):
            before = int(time[0]) if self._time is None else self._time
            time[1:] -= time[:-1].copy()
            time[0] -= before
            time = before + ((time + HALF) % WRAP - HALF).cumsum()
            self._time = int(time[-1])
        return time


def _partial_magic(tail: bytes) -> int:
    """Number of bytes at the end that may be the start of the magic."""
    return next((k for k in range(len(tail), 0, -1) if tail.endswith(MAGIC[:k])), 0)
