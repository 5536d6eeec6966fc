"""Live data as messages (see `robot.recordings.cdr`): blocks of frames and of arm states, cuts, events.

Frames are stored channel by channel as differences from frame to frame: small numbers, which compress well.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from robot.drivers.head.cycle_assembly import Cut
from robot.drivers.head.decoder import Frames
from robot.drivers.head.usb_protocol import CHANNELS
from robot.drivers.ur10.shared_state import ARM_STATE
from robot.recordings.cdr import CDR, MAX_NUMBERS, Malformed
from tactile.base.types import Odometry

NUMBERS = ("host", "robot", "tcp", "speed", "force", "joints")
WORDS = ("mode", "safety", "runtime", "operation", "progress")
"""Fields of an arm state: floating-point numbers and 32-bit words, in the order of the message."""


class Event(NamedTuple):
    """An event of a live session. Attributes: time: s. name: one word, such as `fault` or `discontinuity`.
    text: details."""

    time: float
    name: str
    text: str


def encode_frames(time: float, frames: Frames) -> bytes:
    """Encode a block of frames; `time` is the arrival of the newest one, s."""
    count, whiskers, channels = frames.values.shape
    planes = frames.values.reshape(count, whiskers * channels).T
    parts = [
        struct.pack("<4sd2I", CDR, time, count, count),
        _encode_steps(frames.sequence, "<i8"),
        struct.pack("<2I", whiskers, count),
        _encode_steps(frames.time, "<i8"),
        struct.pack("<2I", channels, count),
        frames.flags.astype("<u4").tobytes(),
        struct.pack("<I", planes.size),
        _encode_steps(planes, "<i2"),
    ]
    return b"".join(parts)


def decode_frames(message: bytes, whiskers: int) -> tuple[float, Frames]:
    """Decode (time, frames) of a head with this number of whiskers; raises `Malformed`."""
    fields = _Fields(message)
    time = fields.number("<d")
    count = fields.size()
    sequence = fields.array("<i8", count)
    if fields.size() != whiskers:
        raise Malformed(f"frames with another number of whiskers than the recording, {whiskers}")
    device = fields.array("<i8", count)
    if fields.size() != CHANNELS:
        raise Malformed(f"frames without exactly {CHANNELS} channels")
    flags = fields.array("<u4", count)
    planes = fields.array("<i2", count * whiskers * CHANNELS).reshape(whiskers * CHANNELS, count)
    fields.end()
    if (flags > 255).any():
        raise Malformed(f"frame flags {int(flags.max())} where 255 is the largest possible")
    values = np.cumsum(planes, axis=1, dtype=np.int16).T.reshape(count, whiskers, CHANNELS)
    return time, Frames(
        np.cumsum(sequence, dtype=np.int64),
        np.cumsum(device, dtype=np.int64),
        flags.astype(np.uint8),
        np.ascontiguousarray(values),
    )


def encode_states(states: np.ndarray) -> bytes:
    """Encode arm states [N], N > 0 (`robot.drivers.ur10.shared_state.ARM_STATE`)."""
    count = len(states)
    numbers = np.concatenate([states[name].reshape(count, -1) for name in NUMBERS], axis=1)
    words = np.stack([states[name].astype("<i4") for name in WORDS])
    parts = [
        struct.pack("<4sd2I", CDR, states["host"][-1], count, count),
        states["counter"].astype("<i8").tobytes(),
        struct.pack("<2I", numbers.shape[1], numbers.size),
        np.ascontiguousarray(numbers.T, "<f8").tobytes(),
        struct.pack("<2I", len(words), words.size),
        words.tobytes(),
    ]
    return b"".join(parts)


def decode_states(message: bytes) -> tuple[float, np.ndarray]:
    """Decode (time, states [N]); raises `Malformed`."""
    fields = _Fields(message)
    time = fields.number("<d")
    count = fields.size()
    counter = fields.array("<i8", count)
    rows = fields.size()
    numbers = fields.array("<f8", rows * count).reshape(rows, count)
    width = fields.size()
    words = fields.array("<i4", width * count).reshape(width, count)
    fields.end()
    if width != len(WORDS) or rows != sum(ARM_STATE[name].itemsize // 8 for name in NUMBERS):
        raise Malformed(f"arm states of {rows} numbers and {width} words")
    states = np.zeros(count, ARM_STATE)
    states["counter"] = counter
    row = 0
    for name in NUMBERS:
        wide = ARM_STATE[name].itemsize // 8
        states[name] = numbers[row : row + wide].T.reshape(states[name].shape)
        row += wide
    for name, word in zip(WORDS, words, strict=True):
        states[name] = word.astype(ARM_STATE[name])
    return time, states


_CUT = struct.Struct("<4s6d3qI?")


def encode_cut(cut: Cut) -> bytes:
    """Encode a cut."""
    return _CUT.pack(
        CDR, cut.time, *cut.odometry, cut.start, cut.number, cut.first, cut.last, cut.frames, cut.seen
    )


def decode_cut(message: bytes) -> Cut:
    """Decode a cut; raises `Malformed`."""
    if len(message) != _CUT.size or not message.startswith(CDR):
        raise Malformed("malformed Cut message")
    _, time, *motion, start, number, first, last, frames, seen = _CUT.unpack(message)
    odometry = Odometry(*(np.float64(value) for value in motion))
    return Cut(number, time, start, first, last, frames, odometry, seen)


def encode_event(event: Event) -> bytes:
    """Encode an event."""
    if ": " in event.name:
        raise ValueError(f"a colon in the event name {event.name!r}")
    text = f"{event.name}: {event.text}".encode() + b"\0"
    return struct.pack("<4sdI", CDR, event.time, len(text)) + text


def decode_event(message: bytes) -> Event:
    """Decode an event; raises `Malformed`."""
    fields = _Fields(message)
    time = fields.number("<d")
    text = fields.array("u1", None).tobytes()
    fields.end()
    name, colon, found = text[:-1].decode().partition(": ")
    if not (colon and text.endswith(b"\0")):
        raise Malformed("an event without a name")
    return Event(time, name, found)


def _encode_steps(value: np.ndarray, kind: str) -> bytes:
    """The first value along the last axis, then differences; both wrap around."""
    return np.diff(value, axis=-1, prepend=value.dtype.type(0)).astype(kind).tobytes()


class _Fields:
    """Reads the fields of a message in order."""

    def __init__(self, message: bytes) -> None:
        if not message.startswith(CDR):
            raise Malformed("a message with another encoding than little-endian CDR")
        self._message, self._place = message, len(CDR)

    def number(self, kind: str) -> float:
        """Read one number."""
        return float(self._take(kind, 1)[0])

    def size(self) -> int:
        """Read a uint32."""
        return int(self._take("<u4", 1)[0])

    def array(self, kind: str, count: int | None) -> np.ndarray:
        """Read an array, which must have `count` numbers if that is given."""
        found = self.size()
        if count is not None and found != count:
            raise Malformed(f"an array of {found} numbers where {count} were expected")
        return self._take(kind, found)

    def end(self) -> None:
        """Require the end of the message."""
        if self._place != len(self._message):
            raise Malformed(f"{len(self._message) - self._place} bytes after the end of the message")

    def _take(self, kind: str, count: int) -> np.ndarray:
        size = np.dtype(kind).itemsize * count
        if count > MAX_NUMBERS or self._place + size > len(self._message):
            raise Malformed("a message that ends too early")
        found = np.frombuffer(self._message, kind, count, self._place)
        self._place += size
        return found
