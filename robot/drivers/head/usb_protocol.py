"""Wire format of a whisker head: frames from it, commands to it, and USB control requests.

All numbers are little-endian; angles are int16 counts of `ANGLE`. The USB bridges of published heads
(BIOTACT) are not documented, so this format is not theirs; another bridge needs its own decoder
and its own `robot.drivers.head.device.Bridge`.

Each sample of the head is one frame of 20 + 2 n c bytes (128 for 18 whiskers of 3 channels):

    u32 magic "WHK1" | u32 sequence | u32 device time, us | u8 flags | u8 n whiskers | u8 c channels
    u8 version | int16[n][c] theta, x, y | u32 CRC-32 of all before it

`sequence` counts all samples since power-on, including dropped ones. It wraps, and so does the device time.

A command, 32 + 2 n bytes:

    u32 magic "WHKC" | u8 version | u8 kind | u8 mode | u8 n | f32 amplitude, rad | f32 frequency, Hz
    f32 gain | f32 window, s | f32 offset, rad | int16[n] of the kind | u32 CRC-32 of all before it

A head executes intact commands of a known kind and ignores all others. After `COMMAND_TIMEOUT` s without a
command it retracts its whiskers and stops its drives, but continues to send frames.
"""

from __future__ import annotations

import struct
import zlib
from enum import IntEnum, IntFlag
from typing import NamedTuple

import numpy as np

from tactile.base.types import Array

VENDOR, PRODUCT = 0x1209, 0x0001
"""USB ids that pid.codes reserves for tests."""
ENDPOINT_IN, ENDPOINT_OUT = 0x81, 0x01
"""Bulk: frames to the host, commands to the head."""
INTERFACE = 0
MAGIC, COMMAND_MAGIC = b"WHK1", b"WHKC"
VERSION = 1
CHANNELS = 3
"""theta, x, y"""
ANGLE = np.pi / 32768
"""rad per count, of theta, x and y alike."""
COMMAND_TIMEOUT = 0.5
"""Time without a command after which a head retracts, s."""
WRAP = 2**32
"""Sequence numbers and device times wrap at this value."""


class FrameFlag(IntFlag):
    """Status flags of a frame."""

    OVERRUN = 1
    """Frames were dropped just before this one: the host did not read them."""
    RCP = 2
    """Feedback in the head reduces an amplitude."""
    FAULT = 4
    """A drive reports a fault."""
    CYCLE = 8
    """The first sample of a whisk."""


class CommandKind(IntEnum):
    """Kind of a command."""

    KEEP = 0
    """Keep-alive; all other fields are ignored."""
    DRIVE = 1
    """Whisk with these parameters from the next cycle on. The n numbers are the contact thresholds of y."""
    AMPLITUDES = 2
    """In mode `OPEN`: the n numbers are the amplitudes of the whiskers for the rest of this cycle; in the
    next one the common amplitude applies again, so a late command is harmless."""
    CENTRE = 3
    """The n numbers are the means of y in free air, the reference of feedback in the head."""


class FeedbackMode(IntEnum):
    """Where the amplitude is reduced on contact."""

    OPEN = 0
    """On the host, if at all, by `CommandKind.AMPLITUDES`."""
    RCP = 1
    """In the head, by the law of `tactile.whisking`."""


class Request(IntEnum):
    """Vendor control requests; answers in parentheses."""

    START = 1
    """Start sending frames (no answer)."""
    STOP = 2
    """Retract, stop the drives and stop sending frames (no answer)."""
    CLOCK = 3
    """(u64: device time, us; frames carry its lower 32 bits.)"""
    IDENTITY = 4
    """(JSON: name, version, whiskers, channels, rate in Hz.)"""


REQUEST_IN, REQUEST_OUT = 0xC0, 0x40
"""bmRequestType: vendor, device."""
MAX_ANSWER = 1024
"""Maximum length of an answer, bytes."""
NO_THRESHOLD = 32767
"""Contact threshold of whiskers without feedback."""


class Command(NamedTuple):
    """One command.

    Attributes:
        kind, mode: see their types. amplitude, offset: rad; a whisk protracts from the offset. frequency: Hz.
        gain: rad per rad. window: averaging time of deflections, s. numbers: [n] int16, meaning by kind.
    """

    kind: CommandKind
    mode: FeedbackMode = FeedbackMode.OPEN
    amplitude: float = 0.0
    frequency: float = 0.0
    gain: float = 0.0
    window: float = 0.0
    offset: float = 0.0
    numbers: np.ndarray = np.zeros(0, np.int16)

    def pack(self) -> bytes:
        """The bytes of the command."""
        numbers = np.asarray(self.numbers, "<i2")
        kind, mode, *drive = self[:-1]
        body = _COMMAND.pack(COMMAND_MAGIC, VERSION, kind, mode, len(numbers), *drive) + numbers.tobytes()
        return body + struct.pack("<I", zlib.crc32(body))

    @classmethod
    def unpack(cls, packet: bytes) -> Command | None:
        """The command in a packet; None if it is invalid."""
        if len(packet) < COMMAND_SIZE or zlib.crc32(packet[:-4]) != int.from_bytes(packet[-4:], "little"):
            return None
        magic, version, kind, mode, count, *drive = _COMMAND.unpack_from(packet)
        ours = magic == COMMAND_MAGIC and version == VERSION
        known = ours and kind in set(CommandKind) and mode in set(FeedbackMode)
        if not known or len(packet) != COMMAND_SIZE + 2 * count or not np.isfinite(drive).all():
            return None
        numbers = np.frombuffer(packet, "<i2", count, _COMMAND.size).astype(np.int16)
        return cls._make([CommandKind(kind), FeedbackMode(mode), *drive, numbers])


_COMMAND = struct.Struct("<4sBBBB5f")
COMMAND_SIZE = _COMMAND.size + 4
"""Length of a command without numbers, bytes: 32."""
KEEP_ALIVE = Command(CommandKind.KEEP)


def frame_dtype(whiskers: int, channels: int = CHANNELS) -> np.dtype:
    """Memory layout of a frame, without padding."""
    head = [(name, "<u4") for name in ("magic", "sequence", "time")]
    head += [(name, "u1") for name in ("flags", "whiskers", "channels", "version")]
    return np.dtype([*head, ("values", "<i2", (whiskers, channels)), ("crc", "<u4")])


def pack_frames(sequence: Array, time: Array, flags: Array, values: Array) -> bytes:
    """The bytes of the frames of N samples.

    Args:
        sequence: [N] of any size. time: [N] us, of any size. flags: [N] `FrameFlag`. values: [N, W, C] int16.
    """
    values = np.asarray(values)
    frames = np.empty(len(values), frame_dtype(*values.shape[1:]))
    frames["magic"] = int.from_bytes(MAGIC, "little")
    frames["sequence"] = np.asarray(sequence, np.int64) % WRAP
    frames["time"] = np.asarray(time, np.int64) % WRAP
    frames["flags"] = flags
    frames["whiskers"], frames["channels"] = values.shape[1:]
    frames["version"] = VERSION
    frames["values"] = values
    size, raw = frames.itemsize, memoryview(frames.tobytes())
    frames["crc"] = [zlib.crc32(raw[k : k + size - 4]) for k in range(0, len(raw), size)]
    return frames.tobytes()


def frame_values(angle: Array, deflection: Array) -> np.ndarray:
    """Values [N, W, 3] int16 of angles [N, W] and deflections [N, W, 2], rad; clipped to int16."""
    return to_counts(np.concatenate([np.asarray(angle)[..., None], np.asarray(deflection)], axis=-1))


def to_counts(value: Array) -> np.ndarray:
    """int16 counts of values in rad."""
    return np.clip(np.rint(np.asarray(value, float) / ANGLE), -32768, 32767).astype(np.int16)


def to_radians(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angles [N, W] and deflections [N, W, 2], rad, of counts [N, W, 3]."""
    value = values * ANGLE
    return value[..., 0], value[..., 1:]
