"""Live recordings are read back exactly: laws, kills, full disks, recovery, damage."""

import re
import resource
import struct
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from zstandard import FRAME_HEADER as ZSTD_MAGIC

from robot.drivers.head.decoder import MAX_FRAMES, Cut, Frames, FrameWindow, assemble_cycle
from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.shared_state import ARM_STATE
from robot.recordings.cdr import TRUTH, Event, decode, encode
from robot.recordings.mcap_reader import UNCLOSED, McapScanner, Recording
from robot.recordings.mcap_writer import WholeChunkFile, recover
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tests.helpers.live import ROOT, until
from tests.robot.conftest import bits
from tests.robot.live import live_recordings as recordings
from tests.robot.live.live_recordings import RATE, START, W, cut_of, open_recorder, rows, session, some_frames
from tests.robot.recordings.conftest import spoilt


def test_a_session_is_read_back_exactly(tmp_path):
    cycles, frames = session(tmp_path / "a.mcap")
    recording = Recording(tmp_path / "a.mcap")
    samples = list(recording)
    assert bits([sample.reading for sample in samples]) == bits(cycles)
    assert [sample.time for sample in samples] == [START + 0.25, START + 1.25, START + 2.25]
    assert [sample.truth is None for sample in samples] == [False, False, True]
    assert not recording.truncated
    assert (recording.info, recording.whiskers, recording.length) == (recordings.INFO, W, 3)
    begun = Event(START, "start", "emulated: a robot, über")
    assert recording.events == (begun, Event(START + 3, "dropped", "1 image"))
    assert [len(cycle.time) for cycle in cycles] == [RATE, 0, RATE]
    assert cycles[1].angle.shape == (0, W)
    assert cycles[1].deflection.shape == (0, W, 2)
    assert bits(recordings.whole(recordings.content(tmp_path / "a.mcap", Frames))) == bits(frames)


def test_a_whisk_is_assembled_from_its_frames():
    frames = some_frames(10, first=90)
    cut = Cut.of(0, 3.0, 2.5, rows(frames, slice(2, 7)), recordings.motion_of_whisk(0))
    cycle = assemble_cycle(frames, cut)
    np.testing.assert_allclose(cycle.time, 2.5 + np.arange(5) / RATE, rtol=0, atol=1e-12)
    values = np.concatenate([cycle.angle[..., None], cycle.deflection], axis=2)
    np.testing.assert_allclose(values, frames.values[2:7] * np.pi / 32768)
    assert cycle.odometry == recordings.motion_of_whisk(0)
    assert all(part.flags.c_contiguous for part in cycle[:3])
    mixed = rows(frames, np.random.default_rng(0).permutation(10))
    assert bits(assemble_cycle(mixed, cut)) == bits(cycle)


@settings(max_examples=40)
@given(st.data())
def test_the_order_of_frames_does_not_matter(tmp_path_factory, data):
    """Some frames are lost or late; cuts overlap, leave gaps or come before their frames."""
    path = tmp_path_factory.getbasetemp() / "law.mcap"
    count = data.draw(st.integers(0, 120))
    frames = some_frames(count, count, first=data.draw(st.sampled_from([0, 2**31, 2**40])))
    order = np.array(data.draw(st.lists(st.integers(0, max(count - 1, 0)), unique=True)), int)[:count]
    order = order[np.argsort(order + np.array([3 * (k % 4 == 0) for k in range(len(order))]), kind="stable")]
    came = rows(frames, order)
    cycles, at = [], 0
    with open_recorder(path) as recorder:
        while True:
            step = data.draw(st.integers(1, 30))
            block = rows(came, slice(at, at + step))
            ahead = rows(came, slice(0, at + step))  # the ring buffer has frames before the recorder
            first = int(frames.sequence[0]) + data.draw(st.integers(-5, 120)) if count else 0
            mine = ahead.select(first, first + data.draw(st.integers(0, 60)))
            cut = cut_of(len(cycles), mine, START + at, seen=data.draw(st.booleans()))
            early = data.draw(st.booleans())
            for whisk in (early, not early):
                if whisk:
                    recorder.add_whisk(cut, mine)
                else:
                    recorder.add_frames(block, START + 0.01 * at)
            cycles.append(assemble_cycle(mine, cut))
            at += step
            if at >= len(order):
                break
    read = [sample.reading for sample in recordings.content(path, Sample)]
    assert bits(read) == bits(cycles)
    numbers = recordings.whole([Frames.blank(W), *recordings.content(path, Frames)]).sequence
    assert sorted(numbers) == sorted(came.sequence)  # each once
    assert not Recording(path).truncated


@given(st.integers(0, 40), st.integers(0, 5), st.integers(0, 2**32))
def test_blocks_round_trip(count, seed, first):
    frames, states = some_frames(count, seed, first), recordings.some_states(count + 1, seed)
    assert bits(back(frames)) == bits((3.5, frames))
    assert encode(Frames.blank(W), (2, 2, 1), W, 3.5) == encode(rows(frames, slice(0)), (2, 2, 1), W, 3.5)
    at, again = back(states)
    assert at == states["host"][-1]
    assert again.dtype == ARM_STATE
    assert all((again[name] == states[name]).all() for name in ARM_STATE.names or ())
    cut = Cut.of(count, 1.5, 1.0, frames, recordings.motion_of_whisk(seed))
    assert bits(back(cut)) == bits((1.5, cut))
    assert cut.seen == (count > 0)
    event = Event(0.1, "fault", "ünder: way")
    assert back(event) == (0.1, event)


def back(content):
    name, _, message = encode(content, (2, 2, 1), W, 3.5)
    return decode(name, message, (2, 2, 1), W)


@given(st.binary(max_size=120), st.sampled_from([0, 1, 2, 3]), st.integers(0, 400), st.integers(0, 2**32 - 1))
def test_invalid_messages_are_refused(noise, kind, place, number):
    frames = some_frames(3)
    parts = frames, recordings.some_states(2), cut_of(0, frames), Event(1.0, "a", "b")
    name, _, good = encode(parts[kind], (2, 2, 1), W, 1.0)
    place = place % len(good)
    changed = good[:place] + struct.pack("<I", number) + good[place + 4 :]
    for bad in (noise, b"\0\1\0\0" + noise, good[:place], changed):
        with suppress(ValueError):
            decode(name, bad, (2, 2, 1), W)
    for bad in (good[: max(place, 1) - 1], good + b"\0"):
        with pytest.raises(ValueError):
            decode(name, bad, (2, 2, 1), W)


def test_data_are_written_within_a_fifth_of_a_second(tmp_path):
    path, late, states = tmp_path / "a.mcap", [], recordings.some_states(125)
    frames, recorder = some_frames(RATE), open_recorder(path)
    for k in range(0, RATE, 2):
        now = START + (k + 1) / RATE
        recorder.add_frames(rows(frames, slice(k, k + 2)), now)
        recorder.add_states(states[(states["host"] > now - 2 / RATE) & (states["host"] <= now)])
        late.append(k + 1 - max([part.sequence[-1] for part in recordings.content(path, Frames)], default=-1))
        known = recordings.content(path, np.ndarray)
        assert now - (known[-1]["host"][-1] if known else START) < 0.2
    assert max(late) / RATE < 0.2
    assert len(recordings.content(path, Frames)) >= 5  # in blocks, not one by one
    recorder.add_whisk(cut_of(0, frames, START + 1.0), frames)
    assert McapScanner(path).__iter__().__next__().reading.angle.shape == (RATE, W)
    recorder.close()


def test_a_cut_must_match_its_frames(tmp_path, monkeypatch):
    frames, recorder = some_frames(20), open_recorder(tmp_path / "a.mcap")
    cut = cut_of(0, frames)
    for wrong in (cut._replace(frames=19), cut._replace(first=1), cut._replace(frames=0, first=50, last=60)):
        with pytest.raises(ValueError, match="frames for a whisk"):
            recorder.add_whisk(wrong, frames)
    with pytest.raises(ValueError, match="a whisk of 20 frames"):
        assemble_cycle(rows(frames, slice(1, 20)), cut)
    with pytest.raises(ValueError, match="colon"):
        recorder.add_event(START, "a: b", "c")
    recorder.add_whisk(cut, frames)
    recorder.close()
    assert Recording(tmp_path / "a.mcap").length == 1

    def one_too_many(part, *sizes):
        return encode(part._replace(frames=part.frames + 1) if isinstance(part, Cut) else part, *sizes)

    with monkeypatch.context() as patch, open_recorder(tmp_path / "b.mcap") as recorder:
        patch.setattr("robot.recordings.mcap_writer.encode", one_too_many)
        recorder.add_whisk(cut, frames)
    scanner = McapScanner(tmp_path / "b.mcap")
    assert list(scanner) == []
    assert scanner.broken == "a whisk of 21 frames, of which 20 are present"


def test_the_frame_window_drops_the_oldest_frames():
    window = FrameWindow(W)
    assert len(window.between(0, 10**9).sequence) == 0
    block = some_frames(1000)
    for k in range(100):
        window.add(block._replace(sequence=block.sequence + 1000 * k))
    frames = window.between(0, 10**9).sequence
    assert MAX_FRAMES <= len(frames) < MAX_FRAMES + 1000
    assert (frames == np.arange(100_000)[-len(frames) :]).all()
    assert (window.between(99_990, 99_992).sequence == [99_990, 99_991, 99_992]).all()


def test_three_threads_write_one_recording(tmp_path):
    frames, states = some_frames(4 * RATE), recordings.some_states(500)
    recorder = open_recorder(tmp_path / "a.mcap")

    def head(k):
        recorder.add_frames(rows(frames, slice(4 * k, 4 * k + 4)), START + 4 * k / RATE)

    def arm(k):
        recorder.add_states(states[5 * k : 5 * k + 5])

    def loop(k):
        mine = rows(frames, slice(k * RATE, (k + 1) * RATE))
        recorder.add_whisk(cut_of(k, mine), mine)

    interval, path = sys.getswitchinterval(), tmp_path / "a.mcap"
    sys.setswitchinterval(1e-5)
    try:
        with recorder, ThreadPoolExecutor(3) as pool:
            rounds = ((head, RATE), (arm, 100), (loop, 4))
            for done in [pool.submit(lambda f, n: [*map(f, range(n))], *one) for one in rounds]:
                done.result(10)
    finally:
        sys.setswitchinterval(interval)
    assert (np.sort(recordings.whole(recordings.content(path, Frames)).sequence) == frames.sequence).all()
    assert (np.concatenate(recordings.content(path, np.ndarray))["host"] == states["host"]).all()
    assert (Recording(path).length, Recording(path).truncated) == (4, False)


def test_rosbags_reads_a_live_recording(tmp_path):
    from rosbags.highlevel import AnyReader

    session(tmp_path / "a.mcap")
    entries = list(McapScanner(tmp_path / "a.mcap").entries())
    written = [(entry.name, entry.message) for entry in entries]
    written += [(TRUTH, entry.truth) for entry in entries if entry.truth is not None]
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        read = [(connection.msgtype, bytes(data)) for connection, _, data in reader.messages()]
        assert sorted(read) == sorted(written)
        for name, data in read:
            assert bytes(reader.typestore.serialize_cdr(reader.deserialize(data, name), name)) == data


WRITER = """
import mmap, struct, sys
from pathlib import Path
from tests.robot.live.live_recordings import cut_of, open_recorder, rows, some_frames

path, beside = map(Path, sys.argv[1:])
recorder, pool = open_recorder(path), some_frames(2000)
with beside.open("r+b") as file:
    counters = mmap.mmap(file.fileno(), 16)
k = 0
while True:
    frames = pool._replace(sequence=pool.sequence + k // 100 * 2000)
    recorder.add_frames(rows(frames, slice(20 * (k % 100), 20 * (k % 100) + 20)), 0.01 * k)
    if k % 100 == 99:
        recorder.add_whisk(cut_of(k // 100, frames, 0.01 * k), frames)
    k += 1
    counters[:16] = struct.pack("<qq", k, k // 100)
"""
CHUNK_HEADER = 1 + 8 + 3 * 8 + 4 + 8 + 8  # bytes


MANY = np.random.default_rng(1).uniform(0, 1, 50).tolist()


@pytest.mark.parametrize("moments", [[0.02, 0.3], pytest.param(MANY, marks=pytest.mark.soak)], ids=len)
def test_a_killed_session_loses_less_than_a_fifth_of_a_second(tmp_path, moments):
    for seconds in moments:
        path, beside = tmp_path / f"{seconds}.mcap", tmp_path / f"{seconds}.bin"
        beside.write_bytes(bytes(16))
        with subprocess.Popen([sys.executable, "-c", WRITER, path, beside], cwd=ROOT) as process:
            try:
                until(lambda counts=beside: counts.read_bytes()[0], "the first block")
                time.sleep(seconds)
            finally:
                process.kill()
        blocks, whisks = struct.unpack("<qq", beside.read_bytes())
        scanner = McapScanner(path)
        parts = [entry.content for entry in scanner.entries() if isinstance(entry.content, Frames)]
        frames = recordings.whole(parts).sequence
        assert frames.tolist() == list(range(len(frames)))
        assert blocks > 20
        assert blocks - len(frames) / 20 <= 20  # 0.2 s of the session
        assert whisks <= scanner.count <= whisks + 1
        assert scanner.broken in (UNCLOSED, "it ends too early")  # killed between two writes, or within one


def test_a_full_disk_is_a_fault_and_the_recording_stays_readable(tmp_path):
    path = tmp_path / "a.mcap"
    frames, recorder = some_frames(6 * RATE), open_recorder(path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
        sizes = []
        for k in range(6 * RATE // 4):
            recorder.add_frames(rows(frames, slice(4 * k, 4 * k + 4)), START + 4 * k / RATE)
            if k % 50 == 49:
                mine = rows(frames, slice(4 * k - RATE + 4, 4 * k + 4))
                recorder.add_whisk(cut_of(k, mine), mine)
            sizes.append(path.stat().st_size)
        fault = recorder.fault
        recorder.add_event(START, "late", "after the fault")
        recorder.close()
        recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert fault is not None
    assert fault is recorder.fault
    assert fault.outcome is SessionOutcome.DISK_FULL
    assert str(path) in fault.detail
    assert max(sizes) < 20_000  # an incomplete chunk is truncated
    recording = Recording(path)
    assert recording.truncated
    assert 1 <= recording.length == len(list(recording)) < 6
    assert recover(path, tmp_path / "b.mcap")[0] == recording.length


def test_a_disk_that_was_full_yields_a_complete_file_in_the_end(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    frames, recorder = some_frames(3 * RATE), open_recorder(path)
    with monkeypatch.context() as patch:
        for k in range(3):
            mine = rows(frames, slice(k * RATE, (k + 1) * RATE))
            if k == 1:
                patch.setattr(WholeChunkFile, "flush", Mock(side_effect=OSError(28, "No space left")))
            recorder.add_whisk(cut_of(k, mine), mine)
    assert recorder.fault is not None
    recorder.close()
    recording = Recording(path)
    assert (recording.length, recording.truncated) == (1, False)


def read(path):
    scanner = McapScanner(path)
    return [entry[:4] for entry in scanner.entries()], scanner.broken


def test_recover_keeps_messages_other_than_samples(tmp_path):
    cut, good = tmp_path / "cut.mcap", tmp_path / "good.mcap"
    session(tmp_path / "whole.mcap")
    data = (tmp_path / "whole.mcap").read_bytes()
    cut.write_bytes(data[: data.rindex(ZSTD_MAGIC)])  # in its last chunk
    before, end = read(cut)
    assert recover(cut, good) == (3, "it ends too early") == (3, end)
    assert read(good) == (before, "")
    again = Recording(good)
    assert not again.truncated
    assert [event.name for event in again.events] == ["start"]
    assert len({type(entry.content) for entry in McapScanner(good).entries()}) == 4


def test_a_recording_without_a_whisk_is_not_recovered(tmp_path):
    path = tmp_path / "a.mcap"
    with open_recorder(path) as recorder:
        recorder.add_frames(some_frames(5), START)
    for action in (lambda: recover(path, tmp_path / "b.mcap"), lambda: Recording(path)):
        with pytest.raises(InputError, match="holds no samples"):
            action()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


@pytest.mark.parametrize("rounds", [150, pytest.param(5000, marks=pytest.mark.soak)])
def test_a_prefix_of_a_damaged_file_is_read(tmp_path, rounds):
    path, bad = tmp_path / "a.mcap", tmp_path / "bad.mcap"
    session(path, whisks=2)
    everything, lengths = read(path)[0], set()
    data, random = path.read_bytes(), np.random.default_rng(rounds)
    for _ in range(rounds):
        bad.write_bytes(spoilt(data, random))
        found, broken = read(bad)
        assert found == everything[: len(found)]
        assert broken or len(found) == len(everything)
        lengths.add(len(found))
    assert len(lengths) > 5


@pytest.mark.parametrize("unsigned", [False, True])
@pytest.mark.parametrize("only", [False, True])
def test_a_skipped_chunk_is_reported(tmp_path, unsigned, only):
    """The chunk's type is damaged; `unsigned` also sets the file's checksum to 0 (absent); an only chunk
    holds the channel too."""
    path = tmp_path / "a.mcap"
    if only:
        with open_recorder(path) as recorder:
            recorder.add_event(START, "start", "and end")
    else:
        session(path, whisks=2)
    everything, data = read(path)[0], path.read_bytes()
    chunks = [found.start() - CHUNK_HEADER for found in re.finditer(re.escape(ZSTD_MAGIC), data)]
    assert len(chunks) == 1 if only else len(chunks) > 10
    for chunk in chunks:
        assert data[chunk] == 6
        bad = bytearray(data)
        bad[chunk] = 0x7F
        if unsigned:
            end = data.index(b"\x0f" + struct.pack("<Q", 4), chunks[-1])
            bad[end + 9 : end + 13] = bytes(4)
        path.write_bytes(bad)
        found, broken = read(path)
        assert found == everything[: len(found)]
        assert broken
