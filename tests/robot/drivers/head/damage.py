"""Streams of a head with damage in transit, from hypothesis or from a seed."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence

import numpy as np
from hypothesis import strategies as st

from robot.drivers.head.usb_protocol import pack_frames

GARBAGE = (b"", b"\0", b"W", b"WH", b"WHK", b"WHK1", b"WHK1WHK1", b"WHKC", b"1", b"WWHK1", b"\xff" * 9)


class Head:
    """A source of frames with consecutive numbers and times."""

    def __init__(self, whiskers: int, channels: int, sequence: int, time: int, seed: int = 0) -> None:
        self.shape = whiskers, channels
        self.sequence, self.time = sequence, time
        self.sent: list[bytes] = []
        self.random = np.random.default_rng(seed)

    def frame(self, ahead: int = 1, later: int = 500, flags: int = 0) -> bytes:
        self.sequence += ahead
        self.time += later
        values = self.random.integers(-32768, 32768, (1, *self.shape)).astype(np.int16)
        self.sent.append(pack_frames([self.sequence], [self.time], [flags], values))
        return self.sent[-1]

    def foreign(self, field: int, value: int) -> bytes:
        """A frame of another head with a valid CRC; `field` 0 changes whiskers, 1 channels, 2 version."""
        body = bytearray(self.frame()[:-4])
        body[13 + field] = value
        return bytes(body) + struct.pack("<I", zlib.crc32(body))

    def repeat(self, back: int) -> bytes:
        return self.sent[-1 - back % len(self.sent)] if self.sent else b""


def flip_bits(frame: bytes, place: int, mask: int) -> bytes:
    data = bytearray(frame)
    data[place % len(data)] ^= mask
    return bytes(data)


EVENTS = st.one_of(
    st.tuples(st.just("frames"), st.integers(1, 40), st.integers(0, 255)),
    st.tuples(st.just("skip"), st.sampled_from([2, 3, 50, 4095, 4096, 4097, 2**31 - 1, 2**31])),
    st.tuples(st.just("back"), st.sampled_from([0, 1, 2, 5, 30, 4094, 4095, 4096, 4097, 2**31])),
    st.tuples(st.just("time"), st.sampled_from([-(2**31), -1, 2**31 - 1, 2**31, 2**32 - 1])),
    st.tuples(st.just("damaged"), st.integers(0, 200), st.integers(1, 255)),
    st.tuples(st.just("front"), st.integers(0, 200)),
    st.tuples(st.just("tail"), st.integers(0, 200)),
    st.tuples(st.just("again"), st.integers(0, 30)),
    st.tuples(st.just("foreign"), st.integers(0, 2), st.integers(0, 255)),
    st.tuples(st.just("garbage"), st.lists(st.sampled_from(GARBAGE), max_size=8)),
    st.tuples(st.just("noise"), st.binary(max_size=60)),
)


def bytes_of(head: Head, event: Sequence) -> bytes:
    """The bytes on the wire for one event."""
    kind, *how = event
    if kind == "frames":
        return b"".join(head.frame(flags=(how[1] + k) & 15) for k in range(how[0]))
    if kind == "skip":
        return head.frame(ahead=how[0])
    if kind == "back":
        return head.frame(ahead=-how[0])
    if kind == "time":
        return head.frame(later=how[0])
    if kind == "damaged":
        return flip_bits(head.frame(), *how)
    if kind == "front":
        return head.frame()[: how[0]]
    if kind == "tail":
        return head.frame()[how[0] :]
    if kind == "again":
        return head.repeat(how[0])
    if kind == "foreign":
        return head.foreign(*how)
    return b"".join(how[0]) if kind == "garbage" else how[0]


@st.composite
def streams(draw: st.DrawFn) -> tuple[bytes, list[int], tuple[int, int]]:
    """Bytes of a stream, cut positions, and shape (whiskers, channels) of its head."""
    shape = draw(st.sampled_from([(2, 1), (1, 3), (18, 3)]))
    start = draw(st.sampled_from([0, 1, 4000, 2**31, 2**32 - 60, 2**32 - 1]))
    head = Head(*shape, start, draw(st.sampled_from([0, 2**32 - 9000])))
    data = b"".join(bytes_of(head, event) for event in draw(st.lists(EVENTS, max_size=14)))
    cuts = draw(st.lists(st.integers(0, len(data)), max_size=12))
    return data, sorted(cuts), shape


def damaged_stream(random: np.random.Generator, size: int, shape: tuple[int, int] = (18, 3)) -> bytes:
    """A long stream with an event after about every sixtieth frame."""
    head, parts, length = Head(*shape, 2**32 - 5000, 2**32 - 10**6), [], 0
    while length < size:
        event = _event(random)
        parts += [bytes_of(head, ("frames", int(random.integers(1, 120)), 0)), bytes_of(head, event)]
        length += sum(map(len, parts[-2:]))
        del head.sent[:-60]
    return b"".join(parts)[:size]


def _event(random: np.random.Generator) -> tuple:
    kind = random.choice(["skip", "back", "damaged", "front", "tail", "again", "foreign", "garbage", "noise"])
    number = int(random.integers(0, 200))
    details: dict[str, tuple] = {
        "skip": (number + 2,),
        "back": (int(random.choice([1, 7, 40, 5000])),),
        "damaged": (number, int(random.integers(1, 256))),
        "front": (number,),
        "tail": (number,),
        "again": (number % 50,),
        "foreign": (number % 3, int(random.integers(0, 256))),
        "garbage": ([bytes(part) for part in random.choice(np.array(GARBAGE, object), 6)],),
        "noise": (random.bytes(number),),
    }
    return (str(kind), *details[str(kind)])
