"""Recordings of killed sessions and on full disks."""

from __future__ import annotations

import resource
import signal
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.drivers.head.decoder import Cut, Frames
from robot.drivers.outcome import SessionOutcome
from robot.recordings.mcap_reader import UNCLOSED, McapScanner, Recording
from robot.recordings.mcap_writer import WholeChunkFile, recover
from tests.robot.live.live_recordings import (
    RATE,
    ROOT,
    START,
    motion_of_whisk,
    open_recorder,
    rows,
    some_frames,
)

WRITER = """
import mmap, struct, sys
from pathlib import Path
import numpy as np
from robot.drivers.head.decoder import Frames
from robot.drivers.head.decoder import Cut
from robot.live.recorder import LiveRecorder
from robot.recordings.mcap_writer import Recorder
from robot.sources.source import SourceDescription
from tactile.base.types import Odometry

path, beside = map(Path, sys.argv[1:])
recorder = LiveRecorder(Recorder(path, SourceDescription((3, 6, 1), 18)))
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
        recorder.add_whisk(Cut.of(k // 100, 0.01 * k, 0.01 * k - 1, mine, motion), mine)
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
    assert scanner.broken in (UNCLOSED, "it ends too early")  # killed between two writes, or within one


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
                recorder.add_whisk(Cut.of(k, START + k, START, mine, motion_of_whisk(k)), mine)
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
    assert recover(path, tmp_path / "b.mcap")[0] == recording.length


def test_a_disk_that_was_full_yields_a_complete_file_in_the_end(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "a.mcap"
    frames, recorder = some_frames(3 * RATE), open_recorder(path)
    with monkeypatch.context() as patch:
        for k in range(3):
            mine = rows(frames, slice(k * RATE, (k + 1) * RATE))
            if k == 1:
                patch.setattr(WholeChunkFile, "flush", _no_room)
            recorder.add_whisk(Cut.of(k, START + k, START + k, mine, motion_of_whisk(k)), mine)
    assert recorder.fault is not None
    recorder.close()
    recording = Recording(path)
    assert (recording.length, recording.truncated) == (1, False)


def _no_room(_: Any) -> None:
    raise OSError(28, "No space left on device")
