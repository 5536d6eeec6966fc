"""Frames, commands, counts of a head, damaged or not, against `oracle.py`; the USB bridge and its errors."""

import errno
import itertools
import struct
import sys
import zlib
from array import array
from contextlib import nullcontext
from random import Random
from unittest.mock import Mock, call

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.head import decoder as decoding
from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.decoder import Decoder, DecoderCounts, SequenceUnwrapper
from robot.drivers.head.device import Bridge, Disconnected, HeadIdentity, Stalled, open_bridge
from robot.drivers.head.driver_config import Address, HeadLinkConfig
from robot.drivers.head.usb_protocol import Command, Request, pack_frames
from tactile.base.errors import InputError
from tests.robot.drivers.head import oracle
from tests.robot.drivers.head.memory import MemoryHead
from tests.robot.drivers.head.oracle import Sample, damaged_stream, decode_reference, flip_bits, streams

INT16 = st.integers(-32768, 32767)
FLOAT = st.floats(width=32, allow_nan=False, allow_infinity=False)
STEPS = st.one_of(st.integers(-9, 12), st.sampled_from([1, 1, 1, 2**31 - 1, 2**31, -(2**31)]))
ARRIVALS = st.tuples(
    st.sampled_from([0, 3, 2**32 - 5]), st.lists(STEPS, max_size=60), st.lists(st.integers(0, 60), max_size=6)
)
"""The first number, the steps from each to the next, and where the numbers are cut into blocks."""


def samples(frames):
    columns = zip(frames.sequence, frames.time, frames.flags, frames.values, strict=True)
    return [Sample(int(n), int(t), int(f), tuple(v.ravel().tolist())) for n, t, f, v in columns]


def stream(count, first=0):
    number = first + np.arange(count)
    return pack_frames(number, 500 * number, np.zeros(count), np.full((count, 18, 3), 7, np.int16))


def check_prefixes(drawn):
    data, cuts, shape = drawn
    decoder, got = Decoder(*shape), []
    for start, end in itertools.pairwise([0, *cuts, len(data)]):
        got += samples(decoder.feed(data[start:end]))
        expected = decode_reference(data[:end], *shape)
        assert (got, decoder.pending) == (expected.samples, expected.pending)
        assert decoder.counts == DecoderCounts(*expected.counts)
        whole = (decoder.counts.good + decoder.counts.duplicates) * wire.frame_dtype(*shape).itemsize
        assert whole + decoder.counts.skipped_bytes + decoder.pending == end


@pytest.mark.parametrize("examples", [150, pytest.param(3000, marks=pytest.mark.soak)])
def test_every_prefix_agrees_with_the_reference_decoder(examples):
    settings(max_examples=examples)(given(streams())(check_prefixes))()


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
    assert (decoder.counts, got) == (DecoderCounts(*expected.counts), expected.samples)


def test_a_damaged_or_cut_frame_costs_no_other_frame():
    data = stream(9)
    before, frame, after = data[: 4 * 128], data[4 * 128 : 5 * 128], data[5 * 128 :]
    for place, mask in itertools.product(range(128), (1, 0x80, 0xFF)):
        decoder = Decoder(18)
        frames = decoder.feed(before + flip_bits(frame, place, mask) + after)
        assert (frames.sequence.tolist(), decoder.counts.missing) == ([0, 1, 2, 3, 5, 6, 7, 8], 1)
        assert decoder.counts.bad == (place >= 4)  # a damaged magic is no frame start
    assert [column.dtype for column in frames] == [np.int64, np.int64, np.uint8, np.int16]
    for start, end in itertools.combinations(range(0, 128, 3), 2):
        frames = Decoder(18).feed(before + frame[:start] + frame[end:] + after)
        assert frames.sequence.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]


def test_after_a_restart_numbers_are_new_and_times_follow_the_device_clock():
    data = stream(50)
    decoder, got = Decoder(18), []
    for _ in range(3):
        got += decoder.feed(data[:-30]).sequence.tolist()
        decoder.restart()
    assert got == sorted(set(got))
    assert [n % 2**32 for n in got] == 3 * list(range(49))
    assert decoder.counts == DecoderCounts(good=147, skipped_bytes=3 * 98, restarts=2)
    data = stream(4, first=2**33 // 500)
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


def check_arrivals(drawn):
    first, steps, cuts = drawn
    raw = [(first + step) % 2**32 for step in itertools.accumulate(steps)]
    mine, streams = SequenceUnwrapper(), []
    for block in np.split(np.array(raw, np.uint32), sorted(cut for cut in cuts if cut <= len(raw))):
        number, new = mine.take(block)
        full = [oracle.accept_number(value, streams) for value in block.tolist()]
        assert [n if taken else None for n, taken in zip(number.tolist(), new.tolist(), strict=True)] == full
        assert (mine.missing, mine.streams) == (sum(stream.missing for stream in streams), len(streams))


@pytest.mark.parametrize("examples", [250, pytest.param(5000, marks=pytest.mark.soak)])
def test_all_orders_of_arrival(examples, monkeypatch):
    """With a small range of late numbers, so that all of them occur."""
    for module in (decoding, oracle):
        monkeypatch.setattr(module, "LATE", 8)
    settings(max_examples=examples)(given(ARRIVALS)(check_arrivals))()


def test_frame_layout():
    values = np.arange(54, dtype=np.int16).reshape(1, 18, 3) - 20
    frame = pack_frames([2**32 + 7], [2**33 + 9], [5], values)
    body = struct.pack("<4sIIBBBB54h", b"WHK1", 7, 9, 5, 18, 3, 1, *values.ravel())
    assert frame == body + struct.pack("<I", zlib.crc32(body))
    assert len(frame) == wire.frame_dtype(18).itemsize == 128


KINDS = st.tuples(st.sampled_from(wire.CommandKind), st.sampled_from(wire.FeedbackMode), *[FLOAT] * 5)


@given(KINDS, st.lists(INT16, max_size=255), st.data())
def test_commands_round_trip_and_damaged_ones_are_refused(drive, numbers, data):
    sent = Command(*drive, np.array(numbers, np.int16))
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
    counts = wire.to_counts([-4.0, -np.pi, 0.0, wire.ANGLE, np.pi, 4.0])
    assert counts.tolist() == [-32768, -32768, 0, 1, 32767, 32767]


usb = pytest.importorskip("usb.core", reason="pyusb is not installed")


@pytest.fixture
def device(monkeypatch):
    import usb.util

    monkeypatch.setattr(usb.util, "claim_interface", lambda device, number: None)
    device = Mock()
    device.read.return_value = array("B", b"abc")
    device.ctrl_transfer.side_effect = lambda kind, *_: array("B", bytes(8)) if kind == wire.REQUEST_IN else 0
    return device


def test_transfers(device):
    bridge = Bridge(device, "usb:here")
    assert bridge.read(4096, 0.02) == b"abc"
    bridge.write(b"command")
    assert bridge.request(Request.CLOCK) == bytes(8)
    assert bridge.request(Request.START) == b""
    assert device.mock_calls == [
        call.get_active_configuration(),  # a configured device is not configured again
        call.read(wire.ENDPOINT_IN, 4096, 20),
        call.write(wire.ENDPOINT_OUT, b"command", 500),
        call.ctrl_transfer(wire.REQUEST_IN, Request.CLOCK, 0, 0, 8, 500),
        call.ctrl_transfer(wire.REQUEST_OUT, Request.START, 0, 0, b"", 500),
    ]
    device.get_active_configuration.side_effect = usb.USBError("none", None, errno.ENOENT)
    Bridge(device, "here")
    device.set_configuration.assert_called_once_with()


ERRORS = {
    Stalled: ("ETIMEDOUT", "EPIPE", "EOVERFLOW"),
    Disconnected: ("ENODEV", "EIO", "ENOENT", "ENXIO", "ESHUTDOWN", "EPROTO"),
    InputError: ("EACCES", "EBUSY"),
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind in ERRORS for name in ERRORS[kind]])
def test_translation_of_usb_errors(device, kind, name):
    """A read that times out has read nothing; a command or request has failed."""
    bridge, number, late = Bridge(device, "usb:here"), getattr(errno, name), name == "ETIMEDOUT"
    error = (usb.USBTimeoutError if late else usb.USBError)("as libusb says", None, number)
    for transfer in (device.read, device.write, device.ctrl_transfer):
        transfer.side_effect = error
    for refused, action in (
        (not late, lambda: bridge.read(4096, 0.02)),
        (True, lambda: bridge.write(b"x")),
        (True, lambda: bridge.request(Request.START)),
    ):
        with pytest.raises(kind) if refused else nullcontext():
            assert action() == b""
    cleared = [wire.ENDPOINT_IN, wire.ENDPOINT_OUT] if kind is Stalled and not late else []
    assert device.clear_halt.mock_calls == [call(endpoint) for endpoint in cleared]


def test_addresses_and_no_head_at_one():
    for text, address in (
        ("usb", Address()),
        ("usb:1d50:60a1", Address(0x1D50, 0x60A1)),
        ("usb:1D50:60a1:A-7", Address(0x1D50, 0x60A1, "A-7")),
        ("127.0.0.11", Address(host="127.0.0.11")),
        ("head.lab:31000", Address(host="head.lab", port=31000)),
    ):
        assert Address.parse(text) == Address.parse(str(address)) == address
        assert HeadLinkConfig(address=text).address == text
    for text in ("", "usb:", "usb:12:34", "usb:1209:0001:", "host:port", "host:70000", "a b", "usbx"):
        with pytest.raises(ValueError, match="not an address of a head"):
            HeadLinkConfig(address=text)
    with pytest.raises(Disconnected, match=r"127\.0\.0\.1:9"):
        open_bridge("127.0.0.1:9")
    with pytest.raises((Disconnected, InputError)):  # with a real libusb: no head or no permission
        open_bridge("usb:1209:0001:there-is-none")


def test_the_error_for_a_missing_library_has_a_cure(monkeypatch):
    from usb.backend import libusb1

    monkeypatch.setattr(libusb1, "get_backend", lambda find_library=None: None)
    with pytest.raises(InputError, match="libusb-package"):
        open_bridge("usb")
    monkeypatch.setitem(sys.modules, "usb", None)
    monkeypatch.setitem(sys.modules, "usb.core", None)
    with pytest.raises(InputError, match=r"ratslam\[live\]"):
        open_bridge("usb")


def test_identities():
    bridge = MemoryHead(18)
    assert HeadIdentity.read(bridge) == HeadIdentity("memory", "1", 18, 3, 2000.0)
    for wrong in (b"", b"[]", b"{}", b'{"name": 1', b'{"name":"","version":"","whiskers":null}'):
        bridge.request = lambda request, wrong=wrong: wrong
        with pytest.raises(InputError, match="identity"):
            HeadIdentity.read(bridge)
