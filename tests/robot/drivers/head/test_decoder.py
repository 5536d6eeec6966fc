"""The decoder agrees with the reference decoder in `oracle.py` for damaged streams in any pieces."""

from __future__ import annotations

import itertools
import subprocess
import sys
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.head.decoder import Decoder, DecoderCounts, Frames
from robot.drivers.head.usb_protocol import FrameFlag, pack_frames
from tests.robot.drivers.head.damage import damaged_stream, flip_bits, streams
from tests.robot.drivers.head.oracle import Sample, decode_reference

ROOT = Path(__file__).parents[4]


def samples(frames: Frames) -> list[Sample]:
    columns = zip(frames.sequence, frames.time, frames.flags, frames.values, strict=True)
    return [Sample(int(n), int(t), int(f), tuple(v.ravel().tolist())) for n, t, f, v in columns]


def stream(count: int, first: int = 0, shape: tuple[int, int] = (18, 3)) -> tuple[bytes, np.ndarray]:
    """Frames in order, 500 us apart, and their values."""
    values = np.random.default_rng(first).integers(-32768, 32768, (count, *shape)).astype(np.int16)
    number = first + np.arange(count)
    return pack_frames(number, 500 * number, np.zeros(count), values), values


def check_prefixes(drawn):
    data, cuts, shape = drawn
    decoder, got = Decoder(*shape), []
    for start, end in itertools.pairwise([0, *cuts, len(data)]):
        got += samples(decoder.feed(data[start:end]))
        expected = decode_reference(data[:end], *shape)
        assert got == expected.samples
        assert decoder.counts == DecoderCounts(*expected.counts)
        assert decoder.pending == expected.pending
        size = 20 + 2 * shape[0] * shape[1]
        whole = decoder.counts.good + decoder.counts.duplicates
        assert end == size * whole + decoder.counts.skipped_bytes + decoder.pending


@settings(max_examples=150)
@given(streams())
def test_every_prefix_agrees_with_the_reference_decoder(drawn):
    check_prefixes(drawn)


@pytest.mark.soak
@settings(max_examples=3000)
@given(streams())
def test_every_prefix_of_many_streams_agrees_with_the_reference_decoder(drawn):
    check_prefixes(drawn)


@given(st.binary(max_size=400), st.integers(1, 7))
def test_noise_yields_no_frames(data, step):
    decoder = Decoder(2, 1)
    for k in range(0, len(data), step):
        assert not len(decoder.feed(data[k : k + step]).sequence)
    assert decoder.counts.good == 0


def test_a_clean_stream_is_decoded_completely():
    data, values = stream(3000, first=2**32 - 1500)
    decoder = Decoder(18)
    parts = [decoder.feed(data[k : k + 4096]) for k in range(0, len(data), 4096)]
    frames = Frames(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    np.testing.assert_array_equal(frames.sequence, 2**32 - 1500 + np.arange(3000))
    assert (np.diff(frames.time) == 500).all()
    np.testing.assert_array_equal(frames.values, values)
    assert (frames.sequence.dtype, frames.time.dtype) == (np.int64, np.int64)
    assert (frames.flags.dtype, frames.values.dtype) == (np.uint8, np.int16)
    assert decoder.counts == DecoderCounts(good=3000)


def test_a_damaged_frame_costs_no_other_frame():
    data, _ = stream(9)
    for place in range(128):
        for mask in (1, 0x80, 0xFF):
            decoder = Decoder(18)
            broken = data[: 4 * 128] + flip_bits(data[4 * 128 : 5 * 128], place, mask) + data[5 * 128 :]
            frames = decoder.feed(broken)
            assert frames.sequence.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]
            assert decoder.counts.missing == 1
            assert decoder.counts.bad == (place >= 4)  # a damaged magic is no frame start


def test_any_lost_bytes_cost_one_frame():
    data, _ = stream(9)
    for start, end in itertools.combinations(range(0, 128, 3), 2):
        decoder = Decoder(18)
        frames = decoder.feed(data[: 4 * 128 + start] + data[4 * 128 + end :])
        assert frames.sequence.tolist() == [0, 1, 2, 3, 5, 6, 7, 8]


def test_a_late_frame_is_not_counted_as_missing():
    data, _ = stream(6)
    order = [0, 1, 4, 3, 3, 5, 2, 2]
    decoder, missing = Decoder(18), []
    got = []
    for k in order:
        got += decoder.feed(data[128 * k : 128 * (k + 1)]).sequence.tolist()
        missing.append(decoder.counts.missing)
    assert missing == [0, 0, 2, 1, 1, 1, 0, 0]
    assert got == [0, 1, 4, 3, 5, 2]
    assert decoder.counts == DecoderCounts(good=6, duplicates=2)


def test_each_overrun_is_counted_once():
    values = np.zeros((5, 2, 1), np.int16)
    flags = [FrameFlag.OVERRUN, 0, FrameFlag.OVERRUN | FrameFlag.CYCLE, FrameFlag.FAULT, FrameFlag.RCP]
    decoder = Decoder(2, 1)
    decoder.feed(pack_frames([0, 1, 7, 8, 9], np.arange(5), flags, values))
    assert decoder.counts == DecoderCounts(good=5, overruns=2, missing=5)


def test_numbers_are_unique_over_streams():
    data, _ = stream(50)
    decoder, got = Decoder(18), []
    for _ in range(3):
        got += decoder.feed(data[:-30]).sequence.tolist()
        decoder.restart()
    assert len(set(got)) == len(got) == 147
    assert got == sorted(got)
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


@pytest.mark.soak
def test_fuzzing(tmp_path):
    pytest.importorskip("atheris", reason="atheris is not installed: pip install atheris")
    words = [
        "-m",
        "tests.robot.drivers.head.fuzz_decoder",
        "-runs=20000",
        "-max_len=400",
        "-seed=1",
        "-verbosity=0",
    ]
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=250, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]


@pytest.mark.soak
def test_ten_million_bytes(record_property):
    random = np.random.default_rng(17)
    data = damaged_stream(random, 10_000_000)
    decoder, got, place, took = Decoder(18), [], 0, 0.0
    while place < len(data):
        step = int(random.choice([1, 7, 127, 129, 512, 4096, 65536]))
        began = time.perf_counter()
        frames = decoder.feed(data[place : place + step])
        took += time.perf_counter() - began
        got += samples(frames)
        place += step
    expected = decode_reference(data, 18, 3)
    assert decoder.counts == DecoderCounts(*expected.counts)
    assert got == expected.samples
    record_property("times_real", 10_000_000 / 256_000 / took)
    print(f"\n{decoder.counts}; {10_000_000 / 256_000 / took:.0f} x real time at 256 kB/s")


def test_a_long_stream_in_random_pieces():
    random = np.random.default_rng(5)
    data = damaged_stream(random, 300_000)
    decoder, got, place = Decoder(18), [], 0
    while place < len(data):
        step = int(random.choice([1, 7, 127, 129, 512, 4096, 65536]))
        got += samples(decoder.feed(data[place : place + step]))
        place += step
    expected = decode_reference(data, 18, 3)
    assert decoder.counts == DecoderCounts(*expected.counts)
    assert got == expected.samples
