"""A live session is read back exactly; invalid messages and cuts are refused."""

from __future__ import annotations

import struct
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.drivers.head.decoder import MAX_FRAMES, Cut, Frames, FrameWindow, assemble_cycle
from robot.drivers.ur10.shared_state import ARM_STATE
from robot.live.recorder import LiveRecorder
from robot.recordings.cdr import TRUTH, Event, decode, encode
from robot.recordings.mcap_reader import McapScanner, Recording
from robot.recordings.mcap_writer import Recorder
from robot.sources.source import SourceDescription
from tactile.base.errors import InputError
from tactile.base.types import Cycle
from tests.robot.live.live_recordings import (
    INFO,
    RATE,
    START,
    W,
    content,
    entries_of,
    motion_of_whisk,
    open_recorder,
    rows,
    same_bits,
    session,
    some_frames,
    some_states,
)


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
    cycle = assemble_cycle(frames, Cut.of(0, 3.0, 2.5, rows(frames, slice(2, 7)), motion_of_whisk(0)))
    np.testing.assert_allclose(cycle.time, 2.5 + np.arange(5) / RATE, rtol=0, atol=1e-12)
    np.testing.assert_allclose(cycle.angle, frames.values[2:7, :, 0] * np.pi / 32768)
    np.testing.assert_allclose(cycle.deflection, frames.values[2:7, :, 1:] * np.pi / 32768)
    assert cycle.odometry == motion_of_whisk(0)
    assert all(part.flags.c_contiguous for part in cycle[:3])
    mixed = rows(frames, np.random.default_rng(0).permutation(10))
    assert same_bits(
        assemble_cycle(mixed, Cut.of(0, 3.0, 2.5, rows(frames, slice(2, 7)), motion_of_whisk(0))), cycle
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
            mine = ahead.select(first, first + data.draw(st.integers(0, 60)))
            cut = Cut.of(
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
    assert same_bits(back(frames), (3.5, frames))
    assert encode(Frames.blank(W), (2, 2, 1), W, 3.5) == encode(rows(frames, slice(0)), (2, 2, 1), W, 3.5)
    at, again = back(states)
    assert at == states["host"][-1]
    assert again.dtype == ARM_STATE
    assert all((again[name] == states[name]).all() for name in ARM_STATE.names or ())
    cut = Cut.of(count, 1.5, 1.0, frames, motion_of_whisk(seed))
    assert same_bits(back(cut), (1.5, cut))
    assert cut.seen == (count > 0)
    event = Event(0.1, "fault", "ünder: way")
    assert back(event) == (0.1, event)


def back(content: Any) -> tuple[float, Any]:
    """The time and the content, encoded and decoded."""
    name, _, message = encode(content, (2, 2, 1), W, 3.5)
    return decode(name, message, (2, 2, 1), W)


@given(st.binary(max_size=120), st.sampled_from([0, 1, 2, 3]), st.integers(0, 400), st.integers(0, 2**32 - 1))
def test_invalid_messages_are_refused(noise: bytes, kind: int, place: int, number: int) -> None:
    frames = some_frames(3)
    cut = Cut.of(0, 1.0, 1.0, frames, motion_of_whisk(0))
    name, _, good = encode((frames, some_states(2), cut, Event(1.0, "a", "b"))[kind], (2, 2, 1), W, 1.0)
    place = place % len(good)
    for bad in (
        noise,
        b"\0\1\0\0" + noise,
        good[:place],
        good[:place] + struct.pack("<I", number) + good[place + 4 :],
    ):
        with suppress(ValueError):
            decode(name, bad, (2, 2, 1), W)
    with pytest.raises(ValueError):
        decode(name, good[: max(place, 1) - 1], (2, 2, 1), W)
    with pytest.raises(ValueError):
        decode(name, good + b"\0", (2, 2, 1), W)


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
    recorder.add_whisk(Cut.of(0, START + 1.0, START, mine, motion_of_whisk(0)), mine)
    assert McapScanner(path).__iter__().__next__().reading.angle.shape == (RATE, W)
    recorder.close()


def test_a_cut_must_match_its_frames(tmp_path: Path) -> None:
    frames, recorder = some_frames(20), open_recorder(tmp_path / "a.mcap")
    cut = Cut.of(0, START, START, frames, motion_of_whisk(0))
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
            "robot.recordings.mcap_writer.encode",
            lambda part, *sizes: encode(
                part._replace(frames=part.frames + 1) if isinstance(part, Cut) else part, *sizes
            ),
        )
        frames = some_frames(20)
        recorder.add_whisk(Cut.of(0, START, START, frames, motion_of_whisk(0)), frames)
    scanner = McapScanner(tmp_path / "a.mcap")
    assert list(scanner) == []
    assert scanner.broken == "a whisk of 21 frames, of which 20 are present"


def test_the_frame_window_agrees_with_the_ring_buffer() -> None:
    window = FrameWindow(W)
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
            recorder.add_whisk(Cut.of(k, START + k, START + k, mine, motion_of_whisk(k)), mine)

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
        cut = Cut.of(0, START, START, Frames.blank(W), motion_of_whisk(0))
        assert not cut.seen
        recorder.add_whisk(cut, Frames.blank(W))
    (sample,) = Recording(tmp_path / "a.mcap")
    assert isinstance(sample.reading, Cycle)
    assert len(sample.reading.time) == 0
    assert sample.reading.odometry == motion_of_whisk(0)
    assert isinstance(cut, Cut)
    refused(
        lambda: LiveRecorder(Recorder(tmp_path / "a.mcap", SourceDescription((1, 1, 1), 1, info=INFO))),
        "exists already",
    )
