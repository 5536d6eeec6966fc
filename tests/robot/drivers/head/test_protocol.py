"""Wire format of a head: layout of frames, round trips of commands and counts."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.head.usb_protocol import (
    ANGLE,
    KEEP_ALIVE,
    Command,
    CommandKind,
    FeedbackMode,
    frame_dtype,
    frame_values,
    pack_frames,
    to_counts,
    to_radians,
)

NUMBERS = st.lists(st.integers(-32768, 32767), max_size=255)
FLOAT = st.floats(width=32, allow_nan=False, allow_infinity=False)


def test_frame_layout():
    values = np.arange(54, dtype=np.int16).reshape(1, 18, 3) - 20
    frame = pack_frames([2**32 + 7], [2**33 + 9], [5], values)
    body = struct.pack("<4sIIBBBB54h", b"WHK1", 7, 9, 5, 18, 3, 1, *values.ravel())
    assert frame == body + struct.pack("<I", zlib.crc32(body))
    assert len(frame) == frame_dtype(18).itemsize == 128


@given(st.sampled_from(CommandKind), st.sampled_from(FeedbackMode), st.tuples(*[FLOAT] * 5), NUMBERS)
def test_commands_round_trip(kind, mode, drive, numbers):
    sent = Command(kind, mode, *drive, np.array(numbers, np.int16))
    packet = sent.pack()
    assert len(packet) == 32 + 2 * len(numbers)
    got = Command.unpack(packet)
    assert got is not None
    assert got[:-1] == sent[:-1]
    assert got.numbers.tolist() == numbers


@given(st.data())
def test_damaged_commands_are_refused(data):
    packet = bytearray(Command(CommandKind.DRIVE, FeedbackMode.RCP, 1, 1, 4, 0.01, 0, np.arange(18)).pack())
    where = data.draw(st.integers(0, len(packet) - 1))
    packet[where] ^= data.draw(st.integers(1, 255))
    assert Command.unpack(bytes(packet)) is None
    assert Command.unpack(bytes(packet[:where])) is None


@pytest.mark.parametrize(
    ("place", "value"), [(0, b"WHK1"), (4, b"\2"), (5, b"\t"), (6, b"\2"), (7, b"\1"), (8, b"\0\0\xc0\x7f")]
)
def test_unknown_commands_are_refused(place, value):
    body = bytearray(KEEP_ALIVE.pack()[:-4])
    assert Command.unpack(bytes(body) + struct.pack("<I", zlib.crc32(body))) is not None
    body[place : place + len(value)] = value
    assert Command.unpack(bytes(body) + struct.pack("<I", zlib.crc32(body))) is None


@given(st.lists(st.integers(-32768, 32767), min_size=3, max_size=3))
def test_counts_round_trip_exactly(values):
    values = np.array([[values]], np.int16)
    np.testing.assert_array_equal(frame_values(*to_radians(values)), values)


def test_counts_are_clipped_to_int16():
    assert to_counts([-4.0, -np.pi, 0.0, ANGLE, np.pi, 4.0]).tolist() == [-32768, -32768, 0, 1, 32767, 32767]
