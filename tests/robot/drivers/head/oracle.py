"""A reference decoder after the definitions of `DecoderCounts`; it works byte by byte."""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple

LATE = 4096


class Sample(NamedTuple):
    sequence: int
    time: int
    flags: int
    values: tuple[int, ...]


class Decoded(NamedTuple):
    """The samples of a stream, its counts in the order of `DecoderCounts`, the number of undecided bytes."""

    samples: list[Sample]
    counts: tuple[int, ...]
    pending: int


class Stream:
    """Frame numbers accepted since the last restart of a head."""

    def __init__(self, number: int) -> None:
        self.first = self.highest = number
        self.numbers = {number}

    def add(self, number: int) -> None:
        self.numbers.add(number)
        self.highest = max(self.highest, number)

    @property
    def missing(self) -> int:
        return self.highest - self.first + 1 - len(self.numbers)


def decode_reference(data: bytes, whiskers: int, channels: int) -> Decoded:
    """The correct result for these bytes; it does not depend on the pieces in which they arrive."""
    body = 16 + 2 * whiskers * channels
    samples: list[Sample] = []
    streams: list[Stream] = []
    bad = skipped = overruns = duplicates = place = 0
    time = None
    while place < len(data):
        here = data[place : place + body + 4]
        if here[:4] != b"WHK1"[: len(here)]:
            skipped, place = skipped + 1, place + 1
            continue
        if len(here) < body + 4:
            break
        _, number, stamp, flags, w, c, version = struct.unpack("<4sIIBBBB", here[:16])
        whole = here[body:] == struct.pack("<I", zlib.crc32(here[:body]))
        if (w, c, version) != (whiskers, channels, 1) or not whole:
            bad, skipped, place = bad + 1, skipped + 1, place + 1
            continue
        place += body + 4
        full = accept_number(number, streams)
        if full is None:
            duplicates += 1
            continue
        # The candidate nearest to the previous time; of two at the same distance, the earlier.
        if time is None:
            time = stamp
        else:
            wraps = (time - stamp) // 2**32
            before = time
            time = min((stamp + 2**32 * (wraps + k) for k in (0, 1)), key=lambda t: (abs(t - before), t))
        overruns += flags & 1
        samples.append(Sample(full, time, flags, struct.unpack(f"<{whiskers * channels}h", here[16:body])))
    missing = sum(stream.missing for stream in streams)
    counts = (len(samples), bad, missing, skipped, overruns, duplicates, max(0, len(streams) - 1))
    return Decoded(samples, counts, len(data) - place)


def accept_number(number: int, streams: list[Stream]) -> int | None:
    """Adds a new frame number to the last stream; returns it unwrapped, or None for a duplicate."""
    if not streams:
        streams.append(Stream(number))
        return number
    stream = streams[-1]
    wraps = stream.highest // 2**32
    for full in (number + 2**32 * (wraps + k) for k in (-1, 0, 1)):
        ahead = stream.highest < full < stream.highest + 2**31
        late = stream.highest - LATE < full <= stream.highest
        if late and (full < stream.first or full in stream.numbers):
            return None
        if ahead or late:
            stream.add(full)
            return full
    streams.append(Stream(number + 2**32 * (wraps + 1)))
    return streams[-1].first
