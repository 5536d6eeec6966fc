"""Frames, commands and counts of a head; the decoder agrees with `oracle.py` for damaged streams."""

from __future__ import annotations

import itertools
import struct
import zlib
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.head import decoder as decoding
from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.decoder import Decoder, DecoderCounts, Frames, SequenceUnwrapper
from robot.drivers.head.usb_protocol import Command, pack_frames
from tests.robot.drivers.head import oracle
from tests.robot.drivers.head.oracle import Sample, damaged_stream, decode_reference, flip_bits, streams

INT16 = st.integers(-32768, 32767)
FLOAT = st.floats(width=32, allow_nan=False, allow_infinity=False)
STEPS = st.one_of(st.integers(-9, 12), st.sampled_from([1, 1, 1, 2**31 - 1, 2**31, -(2**31)]))
ARRIVALS = st.tuples(
    st.sampled_from([0, 3, 2**32 - 5]), st.lists(STEPS, max_size=60), st.lists(st.integers(0, 60), max_size=6)
)
"""The first number, the steps from each to the next, and where the numbers are cut into blocks."""


def samples(frames: Frames) -> list[Sample]:
    columns = zip(frames.sequence, frames.time, frames.flags, frames.values, strict=True)
    return [Sample(int(n), int(t), int(f), tuple(v.ravel().tolist())) for n, t, f, v in columns]


def stream(count: int, first: int = 0) -> tuple[bytes, np.ndarray]:
    """Frames in order, 500 us apart, and their values."""
    values = np.random.default_rng(first).integers(-32768, 32768, (count, 18, 3)).astype(np.int16)
    number = first + np.arange(count)
    return pack_frames(number, 500 * number, np.zeros(count), values), values


def check_prefixes(drawn):
    data, cuts, shape = drawn
    decoder, got = Decoder(*shape), []
    for start, end in itertools.pairwise([0, *cuts, len(data)]):
        got += samples(decoder.feed(data[start:end]))
        expected = decode_reference(data[:end], *shape)
        assert (got, decoder.pending) == (expected.samples, expected.pending)
        assert decoder.counts == DecoderCounts(*expected.counts)
        whole = decoder.counts.good + decoder.counts.duplicates
        assert (
            end == wire.frame_dtype(*shape).itemsize * whole + decoder.counts.skipped_bytes + decoder.pending
        )


@settings(max_examples=150)
@given(streams())
def test_every_prefix_agrees_with_the_reference_decoder(drawn):
    check_prefixes(drawn)


@pytest.mark.soak
@settings(max_examples=3000)
@given(streams())
def test_every_prefix_of_many_streams_agrees_with_the_reference_decoder(drawn):
    check_prefixes(drawn)


@pytest.mark.parametrize("size", [300_000, pytest.param(10_000_000, marks=pytest.mark.soak)])
def test_a_long_stream_in_random_pieces(size):
    random = Random(5)
    data = damaged_stream(random, size)
    decoder, got, place = Decoder(18), [], 0
    while place < len(data):
        step = random.choice([1, 7, 127, 129, 512, 4096, 65536])
        got += samples(decoder.feed(data[place : place + step]))
        place += step
    expected = decode_reference(data, 18, 3)
    assert decoder.counts == DecoderCounts(*expected.counts)
    assert got == expected.samples


def test_a_clean_stream_is_decoded_completely():
    data, values = stream(3000, first=2**32 - 1500)
    decoder = Decoder(18)
    parts = [decoder.feed(data[k : k + 4096]) for k in range(0, len(data), 4096)]
    frames = Frames(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    np.testing.assert_array_equal(frames.sequence, 2**32 - 1500 + np.arange(3000))
    assert (np.diff(frames.time) == 500).all()
    np.testing.assert_array_equal(frames.values, values)
    assert [column.dtype for column in frames] == [np.int64, np.int64, np.uint8, np.int16]
    assert decoder.counts == DecoderCounts(good=3000)


def test_a_damaged_or_cut_frame_costs_no_other_frame():
    data, _ = stream(9)
    before, frame, after = data[: 4 * 128], data[4 * 128 : 5 * 128], data[5 * 128 :]
    for place, mask in itertools.product(range(128), (1, 0x80, 0xFF)):
        decoder = Decoder(18)
        frames = decoder.feed(before + flip_bits(frame, place, mask) + after)
        assert frames.sequence.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]
        assert decoder.counts.missing == 1
        assert decoder.counts.bad == (place >= 4)  # a damaged magic is no frame start
    for start, end in itertools.combinations(range(0, 128, 3), 2):
        frames = Decoder(18).feed(before + frame[:start] + frame[end:] + after)
        assert frames.sequence.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]


def test_numbers_are_unique_over_streams():
    data, _ = stream(50)
    decoder, got = Decoder(18), []
    for _ in range(3):
        got += decoder.feed(data[:-30]).sequence.tolist()
        decoder.restart()
    assert got == sorted(set(got))
    assert [n % 2**32 for n in got] == 3 * list(range(49))
    assert decoder.counts == DecoderCounts(good=147, skipped_bytes=3 * 98, restarts=2)


def test_times_after_a_restart_follow_the_device_clock():
    data, _ = stream(4, first=2**33 // 500)
    decoder = Decoder(18)
    for clock in (3 * 2**32 - 7, 3 * 2**32 + 10**6):
        decoder.restart(clock)
        frames = decoder.feed(data)
        assert abs(frames.time[0] - clock) < 2**31
        assert (frames.time % 2**32 == 500 * (2**33 // 500 + np.arange(4)) % 2**32).all()


def test_decoding_time_is_linear_for_hostile_bytes(monkeypatch):
    """Each byte is examined once, not once per later frame."""
    header = pack_frames([1], [1], [0], np.zeros((1, 18, 3), np.int16))[:16]
    calls, real = [], zlib.crc32
    monkeypatch.setattr(zlib, "crc32", lambda *args: calls.append(1) or real(*args))
    Decoder(18).feed(20_000 * header)
    assert 19_000 < len(calls) <= 20_000


@pytest.fixture(scope="module")
def few():
    """A small range of late numbers, so that all orders of arrival occur."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(decoding, "LATE", 8)
        patch.setattr(oracle, "LATE", 8)
        yield


def check_arrivals(drawn):
    first, steps, cuts = drawn
    raw = [(first + step) % 2**32 for step in itertools.accumulate(steps)]
    mine, streams = SequenceUnwrapper(), []
    for block in np.split(np.array(raw, np.uint32), sorted(cut for cut in cuts if cut <= len(raw))):
        number, new = mine.take(block)
        full = [oracle.accept_number(value, streams) for value in block.tolist()]
        assert [n if taken else None for n, taken in zip(number.tolist(), new.tolist(), strict=True)] == full
        assert mine.missing == sum(stream.missing for stream in streams)
        assert mine.streams == len(streams)


@settings(max_examples=250)
@given(ARRIVALS)
def test_all_orders_of_arrival(few, drawn):
    check_arrivals(drawn)


@pytest.mark.soak
@settings(max_examples=5000)
@given(ARRIVALS)
def test_many_orders_of_arrival(few, drawn):
    check_arrivals(drawn)


def test_frame_layout():
    values = np.arange(54, dtype=np.int16).reshape(1, 18, 3) - 20
    frame = pack_frames([2**32 + 7], [2**33 + 9], [5], values)
    body = struct.pack("<4sIIBBBB54h", b"WHK1", 7, 9, 5, 18, 3, 1, *values.ravel())
    assert frame == body + struct.pack("<I", zlib.crc32(body))
    assert len(frame) == wire.frame_dtype(18).itemsize == 128


@given(
    st.sampled_from(wire.CommandKind),
    st.sampled_from(wire.FeedbackMode),
    st.tuples(*[FLOAT] * 5),
    st.lists(INT16, max_size=255),
    st.data(),
)
def test_commands_round_trip_and_damaged_ones_are_refused(kind, mode, drive, numbers, data):
    sent = Command(kind, mode, *drive, np.array(numbers, np.int16))
    packet = bytearray(sent.pack())
    assert len(packet) == 32 + 2 * len(numbers)
    got = Command.unpack(bytes(packet))
    assert (got[:-1], got.numbers.tolist()) == (sent[:-1], numbers)
    where = data.draw(st.integers(0, len(packet) - 1))
    packet[where] ^= data.draw(st.integers(1, 255))
    assert Command.unpack(bytes(packet)) is None
    assert Command.unpack(bytes(packet[:where])) is None


@pytest.mark.parametrize(
    ("place", "value"), [(0, b"WHK1"), (4, b"\2"), (5, b"\t"), (6, b"\2"), (7, b"\1"), (8, b"\0\0\xc0\x7f")]
)
def test_unknown_commands_are_refused(place, value):
    body = bytearray(wire.KEEP_ALIVE.pack()[:-4])
    assert Command.unpack(bytes(body) + struct.pack("<I", zlib.crc32(body))) is not None
    body[place : place + len(value)] = value
    assert Command.unpack(bytes(body) + struct.pack("<I", zlib.crc32(body))) is None


@given(st.lists(INT16, min_size=3, max_size=3))
def test_counts_round_trip_exactly(values):
    values = np.array([[values]], np.int16)
    np.testing.assert_array_equal(wire.frame_values(*wire.to_radians(values)), values)


def test_counts_are_clipped_to_int16():
    assert wire.to_counts([-4.0, -np.pi, 0.0, wire.ANGLE, np.pi, 4.0]).tolist() == [
        -32768,
        -32768,
        0,
        1,
        32767,
        32767,
    ]
