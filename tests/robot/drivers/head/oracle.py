"""A reference decoder after the definitions of `DecoderCounts`, byte by byte, and streams with damage."""

import struct
import zlib
from collections import namedtuple

import numpy as np
from hypothesis import strategies as st

from robot.drivers.head.usb_protocol import pack_frames

LATE = 4096
Sample = namedtuple("Sample", "sequence time flags values")
Decoded = namedtuple("Decoded", "samples counts pending")
"""The samples of a stream, its counts in the order of `DecoderCounts`, the number of undecided bytes."""


class Stream:
    """Frame numbers accepted since the last restart of a head."""

    def __init__(self, number):
        self.first = self.highest = number
        self.numbers = {number}

    def add(self, number):
        self.numbers.add(number)
        self.highest = max(self.highest, number)

    @property
    def missing(self):
        return self.highest - self.first + 1 - len(self.numbers)


def decode_reference(data, whiskers, channels):
    """The correct result for these bytes; it does not depend on the pieces in which they arrive."""
    body = 16 + 2 * whiskers * channels
    samples = []
    streams = []
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
        before = stamp if time is None else time
        wraps = (before - stamp) // 2**32
        time = min((stamp + 2**32 * (wraps + k) for k in (0, 1)), key=lambda t: (abs(t - before), t))
        overruns += flags & 1
        samples.append(Sample(full, time, flags, struct.unpack(f"<{whiskers * channels}h", here[16:body])))
    missing = sum(stream.missing for stream in streams)
    counts = (len(samples), bad, missing, skipped, overruns, duplicates, max(0, len(streams) - 1))
    return Decoded(samples, counts, len(data) - place)


def accept_number(number, streams):
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


GARBAGE = (b"", b"\0", b"W", b"WH", b"WHK", b"WHK1", b"WHK1WHK1", b"WHKC", b"1", b"WWHK1", b"\xff" * 9)


class Head:
    """A source of frames with consecutive numbers and times."""

    def __init__(self, whiskers, channels, sequence, time, seed=0):
        self.shape = whiskers, channels
        self.sequence, self.time = sequence, time
        self.sent = []
        self.random = np.random.default_rng(seed)

    def frame(self, ahead=1, later=500, flags=0):
        self.sequence += ahead
        self.time += later
        values = self.random.integers(-32768, 32768, (1, *self.shape)).astype(np.int16)
        self.sent.append(pack_frames([self.sequence], [self.time], [flags], values))
        return self.sent[-1]

    def foreign(self, field, value):
        """A frame of another head with a valid CRC; `field` 0 changes whiskers, 1 channels, 2 version."""
        body = bytearray(self.frame()[:-4])
        body[13 + field] = value
        return bytes(body) + struct.pack("<I", zlib.crc32(body))

    def repeat(self, back):
        return self.sent[-1 - back % len(self.sent)] if self.sent else b""


def flip_bits(frame, place, mask):
    data = bytearray(frame)
    data[place % len(data)] ^= mask
    return bytes(data)


def frames(head, count):
    return b"".join(head.frame(flags=k & 15) for k in range(count))


def event(head, random):
    number = random.randrange(201)
    events = (
        lambda: frames(head, 1 + number % 40),
        lambda: head.frame(ahead=random.choice((2, 3, 50, 4095, 4096, 4097, 2**31 - 1, 2**31))),
        lambda: head.frame(ahead=-random.choice((0, 1, 2, 5, 30, 4094, 4095, 4096, 4097, 2**31))),
        lambda: head.frame(later=random.choice((-(2**31), -1, 2**31 - 1, 2**31, 2**32 - 1))),
        lambda: flip_bits(head.frame(), number, random.randrange(1, 256)),
        lambda: head.frame()[:number],
        lambda: head.frame()[number:],
        lambda: head.repeat(number % 31),
        lambda: head.foreign(number % 3, random.randrange(256)),
        lambda: b"".join(random.choice(GARBAGE) for _ in range(number % 9)),
        lambda: bytes(random.randrange(256) for _ in range(number % 61)),
    )
    return random.choice(events)()


@st.composite
def streams(draw):
    """Bytes of a stream, cut positions, and shape (whiskers, channels) of its head."""
    shape = draw(st.sampled_from([(2, 1), (1, 3), (18, 3)]))
    start = draw(st.sampled_from([0, 1, 4000, 2**31, 2**32 - 60, 2**32 - 1]))
    head = Head(*shape, start, draw(st.sampled_from([0, 2**32 - 9000])))
    random, count = draw(st.randoms()), draw(st.integers(0, 14))
    data = b"".join(event(head, random) for _ in range(count))
    return data, sorted(draw(st.lists(st.integers(0, len(data)), max_size=12))), shape


def damaged_stream(random, size):
    """A long stream with an event after about every sixtieth frame."""
    head, data = Head(18, 3, 2**32 - 5000, 2**32 - 10**6), bytearray()
    while len(data) < size:
        data += frames(head, random.randrange(1, 120)) + event(head, random)
        del head.sent[:-60]
    return bytes(data[:size])
