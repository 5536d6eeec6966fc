"""Recovery of live recordings, and damage that is noticed."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robot.recordings.mcap_reader import McapScanner, Recording
from robot.recordings.mcap_writer import recover
from tactile.base.errors import InputError
from tests.robot.live.live_recordings import START, entries_of, open_recorder, same_bits, session, some_frames


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
