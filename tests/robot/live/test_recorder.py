"""A live session is read back exactly, also after its process was killed."""

from __future__ import annotations

import re
import resource
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.head.cycle_assembly import (
    MAX_FRAMES,
    Cut,
    FrameWindow,
    assemble_cycle,
    empty_frames,
    make_cut,
    select_frames,
)
from robot.drivers.head.decoder import Frames
from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.shared_state import ARM_STATE
from robot.live.recorder import LiveRecorder
from robot.recordings.cdr_live import (
    Event,
    decode_cut,
    decode_event,
    decode_frames,
    decode_states,
    encode_cut,
    encode_event,
    encode_frames,
    encode_states,
)
from robot.recordings.mcap_reader import Recording, recover
from robot.recordings.mcap_scanner import McapScanner, RecordingEntry
from robot.recordings.mcap_writer import WholeChunkFile
from robot.recordings.schemas import TRUTH
from robot.sources.source_info import SourceInfo
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Odometry
from tactile.whiskers.head_geometry import HeadConfig

ROOT = Path(__file__).parents[3]
W, RATE = 4, 200
START = 5e4
"""Start of a session, host time, s."""
INFO = SourceInfo(raw_whiskers=True, head=HeadConfig(rest_deg=74.0))


def some_frames(count: int, seed: int = 0, first: int = 0) -> Frames:
    random = np.random.default_rng(seed)
    values = random.integers(-(2**15), 2**15, (count, W, 3)).astype(np.int16)
    number = first + np.arange(count)
    return Frames(
        number, 7_000_000 + number * (1_000_000 // RATE), random.integers(0, 16, count, np.uint8), values
    )


def some_states(count: int, seed: int = 0, begin: float = START) -> np.ndarray:
    random = np.random.default_rng(seed)
    states = np.zeros(count, ARM_STATE)
    for name in ARM_STATE.names or ():
        shape = states[name].shape
        if ARM_STATE[name].base.kind == "f":
            states[name] = random.normal(size=shape)
        else:
            states[name] = random.integers(0, 2**31, shape)
    states["progress"], states["safety"] = -1, 2**31 + 5
    states["host"] = begin + np.arange(count) / 125
    return states


def rows(frames: Frames, which: Any) -> Frames:
    return Frames(*(column[which] for column in frames))


def motion_of_whisk(k: int) -> Odometry:
    return Odometry(*(np.float64(value) for value in (0.01 * (k % 3), 0.002, 0.05, 1.0)))


def same_bits(one: Any, other: Any) -> bool:
    """Whether two tuples of arrays are equal in every bit, shape, dtype and order in memory."""
    if isinstance(one, tuple):
        return type(one) is type(other) and all(map(same_bits, one, other))
    a, b = np.asarray(one), np.asarray(other)
    alike = a.flags.c_contiguous == b.flags.c_contiguous
    return alike and (a.shape, a.dtype, a.tobytes()) == (b.shape, b.dtype, b.tobytes())


def open_recorder(path: Path) -> LiveRecorder:
    path.unlink(missing_ok=True)
    return LiveRecorder(path, view_shape=(2, 2, 1), whiskers=W, rate_hz=1.0, info=INFO)


def content(path: Path, kind: type) -> list[Any]:
    return [entry.content for entry in McapScanner(path).entries() if isinstance(entry.content, kind)]


def session(path: Path, whisks: int = 3) -> tuple[list[Cycle], Frames, np.ndarray]:
    """Records whisks, arm states and two events; returns the whisk cycles, all frames and all states."""
    frames, states = some_frames(whisks * RATE, seed=whisks), some_states(whisks * 125)
    recorder = open_recorder(path)
    cycles = []
    recorder.add_event(START, "start", "emulated: a robot, über")
    for k in range(whisks):
        for block in np.split(np.arange(k * RATE, (k + 1) * RATE), RATE // 4):
            recorder.add_frames(rows(frames, block), START + block[-1] / RATE)
            recorder.add_states(
                states[
                    (states["host"] > START + block[0] / RATE - 0.02)
                    & (states["host"] <= START + block[-1] / RATE)
                ]
            )
        mine = rows(frames, slice(k * RATE, (k + 1) * RATE))
        cut = make_cut(k, START + k + 0.25, START + k, mine, motion_of_whisk(k), seen=k != 1)
        recorder.add_whisk(cut, mine, np.array([0.01 * k, 0.0, 0.05 * k]) if k != 2 else None)
        cycles.append(assemble_cycle(mine, cut))
    recorder.add_event(START + whisks, "dropped", "1 image")
    recorder.close()
    return cycles, frames, states


def test_a_session_is_read_back_exactly(tmp_path: Path) -> None:
    cycles, frames, _ = session(tmp_path / "a.mcap")
    recording = Recording(tmp_path / "a.mcap")
    samples = list(recording)
    assert all(same_bits(sample.reading, cycle) for sample, cycle in zip(samples, cycles, strict=True))
    assert [sample.time for sample in samples] == [START + 0.25, START + 1.25, START + 2.25]
    assert [sample.truth is None for sample in samples] == [False, False, True]
    assert not recording.truncated
    assert (recording.info, recording.whiskers, recording.length) == (INFO, W, 3)
    assert recording.events == (
        Event(START, "start", "emulated: a robot, über"), Event(START + 3, "dropped", "1 image")
    )  # fmt: skip
    assert [len(cycle.time) for cycle in cycles] == [RATE, 0, RATE]
    assert cycles[1].angle.shape == (0, W)
    assert cycles[1].deflection.shape == (0, W, 2)
    # The frames of a dropped image are recorded too.
    parts = content(tmp_path / "a.mcap", Frames)
    assert same_bits(Frames(*(np.concatenate(part) for part in zip(*parts, strict=True))), frames)


def test_a_whisk_is_assembled_from_its_frames() -> None:
    frames = some_frames(10, first=90)
    cycle = assemble_cycle(frames, make_cut(0, 3.0, 2.5, rows(frames, slice(2, 7)), motion_of_whisk(0)))
    np.testing.assert_allclose(cycle.time, 2.5 + np.arange(5) / RATE, rtol=0, atol=1e-12)
    np.testing.assert_allclose(cycle.angle, frames.values[2:7, :, 0] * np.pi / 32768)
    np.testing.assert_allclose(cycle.deflection, frames.values[2:7, :, 1:] * np.pi / 32768)
    assert cycle.odometry == motion_of_whisk(0)
    assert all(part.flags.c_contiguous for part in cycle[:3])
    mixed = rows(frames, np.random.default_rng(0).permutation(10))
    assert same_bits(
        assemble_cycle(mixed, make_cut(0, 3.0, 2.5, rows(frames, slice(2, 7)), motion_of_whisk(0))), cycle
    )


@settings(max_examples=40)
@given(st.data())
def test_the_order_of_frames_does_not_matter(tmp_path_factory: Any, data: st.DataObject) -> None:
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
            mine = select_frames(ahead, first, first + data.draw(st.integers(0, 60)))
            cut = make_cut(
                len(cycles), START + at, START, mine, motion_of_whisk(at), seen=data.draw(st.booleans())
            )
            early = data.draw(st.booleans())
            if early:
                recorder.add_whisk(cut, mine)
            recorder.add_frames(block, START + 0.01 * at)
            if not early:
                recorder.add_whisk(cut, mine)
            cycles.append(assemble_cycle(mine, cut))
            at += step
            if at >= len(order):
                break
    scanner = McapScanner(path)
    entries = list(scanner.entries())
    assert not scanner.broken
    samples = [entry.content for entry in entries if hasattr(entry.content, "reading")]
    assert all(same_bits(sample.reading, cycle) for sample, cycle in zip(samples, cycles, strict=True))
    numbers = [entry.content.sequence for entry in entries if isinstance(entry.content, Frames)]
    assert sorted(np.concatenate([np.zeros(0, int), *numbers])) == sorted(came.sequence)  # each once


@given(st.integers(0, 40), st.integers(0, 5), st.integers(0, 2**32))
def test_blocks_round_trip(count: int, seed: int, first: int) -> None:
    frames, states = some_frames(count, seed, first), some_states(count + 1, seed)
    assert same_bits(decode_frames(encode_frames(3.5, frames), W), (3.5, frames))
    assert encode_frames(3.5, empty_frames(W)) == encode_frames(3.5, rows(frames, slice(0)))
    at, again = decode_states(encode_states(states))
    assert at == states["host"][-1]
    assert again.dtype == ARM_STATE
    assert all((again[name] == states[name]).all() for name in ARM_STATE.names or ())
    cut = make_cut(count, 1.5, 1.0, frames, motion_of_whisk(seed))
    assert same_bits(decode_cut(encode_cut(cut)), cut)
    assert cut.seen == (count > 0)
    event = Event(0.1, "fault", "ünder: way")
    assert decode_event(encode_event(event)) == event


@given(st.binary(max_size=120), st.sampled_from([0, 1, 2, 3]), st.integers(0, 400), st.integers(0, 2**32 - 1))
def test_invalid_messages_are_refused(noise: bytes, kind: int, place: int, number: int) -> None:
    frames = some_frames(3)
    decode: Any = (lambda m: decode_frames(m, W), decode_states, decode_cut, decode_event)[kind]
    good = (
        encode_frames(1.0, frames), encode_states(some_states(2)),
        encode_cut(make_cut(0, 1.0, 1.0, frames, motion_of_whisk(0))), encode_event(Event(1.0, "a", "b")),
    )[kind]  # fmt: skip
    place = place % len(good)
    for bad in (
        noise,
        b"\0\1\0\0" + noise,
        good[:place],
        good[:place] + struct.pack("<I", number) + good[place + 4 :],
    ):
        with suppress(ValueError):
            decode(bad)
    with pytest.raises(ValueError):
        decode(good[: max(place, 1) - 1])
    with pytest.raises(ValueError):
        decode(good + b"\0")


def test_data_are_written_within_a_fifth_of_a_second(tmp_path: Path) -> None:
    """The file is read after every call; delays are differences of the passed times."""
    path = tmp_path / "a.mcap"
    frames, recorder = some_frames(RATE), open_recorder(path)
    states = some_states(125)
    late = []
    for k in range(0, RATE, 2):
        now = START + (k + 1) / RATE
        recorder.add_frames(rows(frames, slice(k, k + 2)), now)
        recorder.add_states(states[(states["host"] > now - 2 / RATE) & (states["host"] <= now)])
        got = [part.sequence[-1] for part in content(path, Frames)]
        late.append(k + 1 - max(got, default=-1))
        known = content(path, np.ndarray)
        assert now - (known[-1]["host"][-1] if known else START) < 0.2
    assert max(late) / RATE < 0.2
    assert len(content(path, Frames)) >= 5  # in blocks, not one by one
    mine = rows(frames, slice(0, RATE))
    recorder.add_whisk(make_cut(0, START + 1.0, START, mine, motion_of_whisk(0)), mine)
    assert McapScanner(path).__iter__().__next__().reading.angle.shape == (RATE, W)
    recorder.close()


WRITER = """
import mmap, struct, sys
from pathlib import Path
import numpy as np
from robot.drivers.head.decoder import Frames
from robot.drivers.head.cycle_assembly import make_cut
from robot.live.recorder import LiveRecorder
from robot.sources.source_info import SourceInfo
from tactile.base.types import Odometry

path, beside = map(Path, sys.argv[1:])
recorder = LiveRecorder(path, view_shape=(3, 6, 1), whiskers=18, info=SourceInfo())
random = np.random.default_rng(0)
pool = random.integers(-300, 300, (2000, 18, 3)).astype(np.int16)
with beside.open("r+b") as file:
    counters = mmap.mmap(file.fileno(), 16)
k = 0
while True:
    number = np.arange(20 * k, 20 * k + 20)
    frames = Frames(number, number * 500, np.zeros(20, np.uint8), pool[number % 2000])
    recorder.add_frames(frames, 0.01 * k)
    if k % 100 == 99:
        number = np.arange(20 * k - 1980, 20 * k + 20)
        mine = Frames(number, number * 500, np.zeros(2000, np.uint8), pool[number % 2000])
        motion = Odometry(0.01, 0.0, 0.0, 1.0)
        recorder.add_whisk(make_cut(k // 100, 0.01 * k, 0.01 * k - 1, mine, motion), mine)
    k += 1
    counters[:16] = struct.pack("<qq", k, k // 100)
"""


def kill_writer(folder: Path, seconds: float) -> tuple[int, int, Path]:
    """Kills a writer after some seconds; returns its blocks of 10 ms, its whisks and its file."""
    path, beside = folder / "killed.mcap", folder / "beside"
    path.unlink(missing_ok=True)
    beside.write_bytes(bytes(16))
    process = subprocess.Popen([sys.executable, "-c", WRITER, path, beside], cwd=ROOT)
    try:
        patience = time.monotonic() + 60
        while not beside.read_bytes()[0] and time.monotonic() < patience:
            time.sleep(0.01)
        time.sleep(seconds)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait(60)
    blocks, whisks = struct.unpack("<qq", beside.read_bytes())
    return blocks, whisks, path


def check_loss(folder: Path, seconds: float) -> None:
    blocks, whisks, path = kill_writer(folder, seconds)
    scanner = McapScanner(path)
    newest = -1
    for entry in scanner.entries():
        if isinstance(entry.content, Frames):
            assert entry.content.sequence[0] == newest + 1
            newest = int(entry.content.sequence[-1])
    assert blocks > 20
    assert blocks - (newest + 1) / 20 <= 20  # 0.2 s of the session
    assert whisks <= scanner.count <= whisks + 1
    assert scanner.broken == "it ends too early"


def test_a_killed_session_loses_less_than_a_fifth_of_a_second(tmp_path: Path) -> None:
    for seconds in (0.02, 0.17, 0.4):
        check_loss(tmp_path, seconds)


@pytest.mark.soak
def test_many_killed_sessions(tmp_path: Path) -> None:
    for seconds in np.random.default_rng(1).uniform(0, 1, 50):
        check_loss(tmp_path, float(seconds))


def test_a_full_disk_is_a_fault_and_the_recording_stays_readable(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    frames, recorder = some_frames(6 * RATE), open_recorder(path)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
        sizes = []
        for k in range(6 * RATE // 4):
            mine = rows(frames, slice(4 * k, 4 * k + 4))
            recorder.add_frames(mine, START + 4 * k / RATE)
            if k % 50 == 49:
                mine = rows(frames, slice(4 * k - RATE + 4, 4 * k + 4))
                recorder.add_whisk(make_cut(k, START + k, START, mine, motion_of_whisk(k)), mine)
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
    assert "free space" in fault.detail
    assert max(sizes) < 20_000  # an incomplete chunk is truncated
    recording = Recording(path)
    assert recording.truncated
    assert 1 <= recording.length == len(list(recording)) < 6
    assert recover(path, tmp_path / "b.mcap").samples == recording.length


def test_a_disk_that_was_full_yields_a_complete_file_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    frames, recorder = some_frames(3 * RATE), open_recorder(path)
    with monkeypatch.context() as patch:
        for k in range(3):
            mine = rows(frames, slice(k * RATE, (k + 1) * RATE))
            if k == 1:
                patch.setattr(WholeChunkFile, "flush", _no_room)
            recorder.add_whisk(make_cut(k, START + k, START + k, mine, motion_of_whisk(k)), mine)
    assert recorder.fault is not None
    recorder.close()
    recording = Recording(path)
    assert (recording.length, recording.truncated) == (1, False)


def _no_room(_: Any) -> None:
    raise OSError(28, "No space left on device")


def entries_of(path: Path) -> list[RecordingEntry]:
    return list(McapScanner(path).entries())


def test_recover_keeps_messages_other_than_samples(tmp_path: Path) -> None:
    session(tmp_path / "whole.mcap")
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: data.rindex(b"\x28\xb5\x2f\xfd")])  # in its last chunk
    before = entries_of(tmp_path / "cut.mcap")
    report = recover(tmp_path / "cut.mcap", tmp_path / "good.mcap")
    assert report == (3, "it ends too early")
    after = entries_of(tmp_path / "good.mcap")
    assert [entry[:4] for entry in after] == [entry[:4] for entry in before]
    assert len({entry.name for entry in after}) == 4
    again = Recording(tmp_path / "good.mcap")
    assert not again.truncated
    assert [event.name for event in again.events] == ["start"]
    assert all(
        same_bits(a.reading, b.reading) for a, b in zip(again, Recording(tmp_path / "cut.mcap"), strict=True)
    )


def test_a_recording_without_a_whisk_is_not_recovered(tmp_path: Path) -> None:
    with open_recorder(tmp_path / "a.mcap") as recorder:
        recorder.add_frames(some_frames(5), START)
    for action in (
        lambda: recover(tmp_path / "a.mcap", tmp_path / "b.mcap"),
        lambda: Recording(tmp_path / "a.mcap"),
    ):
        with pytest.raises(InputError, match="holds no samples"):
            action()
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def damaged_copies(data: bytes, seed: int, rounds: int) -> Iterator[bytes]:
    random = np.random.default_rng(seed)
    for _ in range(rounds):
        bad = bytearray(data)
        for place in random.integers(0, len(bad), random.integers(1, 4)):
            match int(random.integers(4)):
                case 0:
                    bad[place % len(bad)] ^= 1 << int(random.integers(8))
                case 1:
                    bad[place : place + int(random.integers(1, 4000))] = b""
                case 2:
                    bad[place : place + 16] = bytes(16)
                case _:
                    del bad[place:]
        yield bytes(bad)


@pytest.mark.parametrize("rounds", [150, pytest.param(5000, marks=pytest.mark.soak)])
def test_a_prefix_of_a_damaged_file_is_read(tmp_path: Path, rounds: int) -> None:
    session(tmp_path / "a.mcap", whisks=2)
    whole = [entry[:4] for entry in entries_of(tmp_path / "a.mcap")]
    lengths = set()
    for bad in damaged_copies((tmp_path / "a.mcap").read_bytes(), rounds, rounds):
        (tmp_path / "bad.mcap").write_bytes(bad)
        scanner = McapScanner(tmp_path / "bad.mcap")
        found = [entry[:4] for entry in scanner.entries()]
        assert found == whole[: len(found)]
        assert scanner.broken or len(found) == len(whole)
        lengths.add(len(found))
    assert len(lengths) > 5


@pytest.mark.parametrize("unsigned", [False, True])
def test_a_skipped_chunk_is_reported(tmp_path: Path, unsigned: bool) -> None:
    """The chunk's type is damaged; `unsigned` also sets the file's checksum to 0 (absent)."""
    session(tmp_path / "a.mcap", whisks=2)
    whole = [entry[:4] for entry in entries_of(tmp_path / "a.mcap")]
    data = (tmp_path / "a.mcap").read_bytes()
    chunks = [found.start() - CHUNK_HEADER for found in re.finditer(re.escape(b"\x28\xb5\x2f\xfd"), data)]
    assert len(chunks) > 10
    check_skipped_chunks(tmp_path, data, chunks, whole, unsigned)


@pytest.mark.parametrize("unsigned", [False, True])
def test_a_skipped_only_chunk_is_reported(tmp_path: Path, unsigned: bool) -> None:
    """The chunk holds the channel too."""
    with open_recorder(tmp_path / "a.mcap") as recorder:
        recorder.add_event(START, "start", "and end")
    data = (tmp_path / "a.mcap").read_bytes()
    check_skipped_chunks(tmp_path, data, [data.index(b"\x28\xb5\x2f\xfd") - CHUNK_HEADER], [], unsigned)


def check_skipped_chunks(
    folder: Path, data: bytes, chunks: list[int], whole: list[Any], unsigned: bool
) -> None:
    for chunk in chunks:
        assert data[chunk] == 6
        bad = bytearray(data)
        bad[chunk] = 0x7F
        if unsigned:
            end = data.index(b"\x0f" + struct.pack("<Q", 4), chunks[-1])
            bad[end + 9 : end + 13] = bytes(4)
        (folder / "bad.mcap").write_bytes(bad)
        scanner = McapScanner(folder / "bad.mcap")
        found = [entry[:4] for entry in scanner.entries()]
        assert found == whole[: len(found)]
        assert scanner.broken


CHUNK_HEADER = 1 + 8 + 3 * 8 + 4 + 8 + 8
"""Bytes from a chunk's beginning to its content."""


def test_a_cut_must_match_its_frames(tmp_path: Path) -> None:
    frames, recorder = some_frames(20), open_recorder(tmp_path / "a.mcap")
    cut = make_cut(0, START, START, frames, motion_of_whisk(0))
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


def test_a_cut_without_its_frames_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recorder is patched to state one frame too many."""
    with monkeypatch.context() as patch, open_recorder(tmp_path / "a.mcap") as recorder:
        patch.setattr(
            "robot.live.recorder.encode_cut", lambda cut: encode_cut(cut._replace(frames=cut.frames + 1))
        )
        frames = some_frames(20)
        recorder.add_whisk(make_cut(0, START, START, frames, motion_of_whisk(0)), frames)
    scanner = McapScanner(tmp_path / "a.mcap")
    assert list(scanner) == []
    assert scanner.broken == "a whisk of 21 frames, of which 20 are present"


def test_the_frame_window_agrees_with_the_ring_buffer() -> None:
    window = FrameWindow(empty_frames(W))
    assert len(window.between(0, 10**9).sequence) == 0
    block = some_frames(1000)
    for k in range(100):
        window.add(block._replace(sequence=block.sequence + 1000 * k))
    frames = window.between(0, 10**9).sequence
    assert MAX_FRAMES <= len(frames) < MAX_FRAMES + 1000
    assert (np.diff(frames) == 1).all()
    assert frames[-1] == 99_999
    assert (window.between(99_990, 99_992).sequence == [99_990, 99_991, 99_992]).all()


def test_three_threads_write_one_recording(tmp_path: Path) -> None:
    frames, states = some_frames(4 * RATE), some_states(500)
    recorder = open_recorder(tmp_path / "a.mcap")

    def head() -> None:
        for k in range(0, 4 * RATE, 4):
            recorder.add_frames(rows(frames, slice(k, k + 4)), START + k / RATE)

    def arm() -> None:
        for k in range(0, 500, 5):
            recorder.add_states(states[k : k + 5])

    def loop() -> None:
        for k in range(4):
            mine = rows(frames, slice(k * RATE, (k + 1) * RATE))
            recorder.add_whisk(make_cut(k, START + k, START + k, mine, motion_of_whisk(k)), mine)

    threads = [threading.Thread(target=target) for target in (head, arm, loop)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(10)
    finally:
        sys.setswitchinterval(interval)
    recorder.close()
    scanner = McapScanner(tmp_path / "a.mcap")
    entries = list(scanner.entries())
    assert not scanner.broken
    numbers = np.concatenate([e.content.sequence for e in entries if isinstance(e.content, Frames)])
    assert (np.sort(numbers) == frames.sequence).all()
    hosts = np.concatenate([e.content["host"] for e in entries if isinstance(e.content, np.ndarray)])
    assert (hosts == states["host"]).all()
    assert scanner.count == 4


def test_rosbags_reads_a_live_recording(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    session(tmp_path / "a.mcap")
    entries = entries_of(tmp_path / "a.mcap")
    written = [(entry.name, entry.message) for entry in entries]
    written += [(TRUTH, entry.truth) for entry in entries if entry.truth is not None]
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        read = [(connection.msgtype, bytes(data)) for connection, _, data in reader.messages()]
        assert sorted(read) == sorted(written)
        for name, data in read:
            assert bytes(reader.typestore.serialize_cdr(reader.deserialize(data, name), name)) == data


def test_an_unseen_cut_needs_no_frames(tmp_path: Path, refused: Callable[..., InputError]) -> None:
    with open_recorder(tmp_path / "a.mcap") as recorder:
        cut = make_cut(0, START, START, empty_frames(W), motion_of_whisk(0))
        assert not cut.seen
        recorder.add_whisk(cut, empty_frames(W))
    (sample,) = Recording(tmp_path / "a.mcap")
    assert isinstance(sample.reading, Cycle)
    assert len(sample.reading.time) == 0
    assert sample.reading.odometry == motion_of_whisk(0)
    assert isinstance(cut, Cut)
    refused(
        lambda: LiveRecorder(tmp_path / "a.mcap", view_shape=(1, 1, 1), whiskers=1, info=INFO),
        "exists already",
    )
