"""Truncated and damaged recordings: a prefix of the samples or one error."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from robot.recordings.input_judge import InputJudge
from robot.recordings.mcap_reader import Recording
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Observation, Report, Whisk
from tests.robot.recordings.mcap_samples import (
    INFO,
    ZSTD_MAGIC,
    same_bits,
    some_samples,
    write_recording,
)


def check_prefix(path: Path, samples: list[Sample]) -> int:
    """Checks that a damaged file gives a prefix of the samples or one InputError; returns their number."""
    warnings: list[str] = []
    source: Recording | None
    try:
        source = Recording(path, InputJudge(warn=warnings.append))
    except InputError as error:
        message = str(error)
        source = None
    if source is None:
        assert str(path) in message
        return 0
    read = list(source)
    assert same_bits(read, samples[: len(read)])
    assert source.info == INFO.model_copy(update={"raw_whiskers": source.info.raw_whiskers})
    assert source.length == len(read)
    assert warnings == ([source.warning] if source.truncated else [])
    assert source.truncated or len(read) == len(samples)
    return len(read)


@pytest.mark.parametrize("step", [pytest.param(1, marks=pytest.mark.soak), 11])
def test_a_recording_truncated_at_any_byte_yields_a_prefix(step: int, tmp_path: Path) -> None:
    """The least number of samples with several chunks and every kind of reading."""
    samples = some_samples(5)
    assert {type(sample.reading) for sample in samples} == {Observation, Whisk, Cycle, Report}
    path = write_recording(tmp_path / "cut.mcap", samples, chunk_s=1.0)
    content = path.read_bytes()
    assert content.count(ZSTD_MAGIC) == 3
    counts = []
    for size in reversed(range(0, len(content), step)):
        os.truncate(path, size)
        counts.append(check_prefix(path, samples))
    assert counts == sorted(counts, reverse=True)
    assert set(counts) == {0, 1, 3, 5}


def fuzz(content: bytes, samples: list[Sample], path: Path, rounds: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(rounds):
        bad = bytearray(content)
        for place in rng.integers(0, len(bad), rng.integers(1, 4)):
            match int(rng.integers(4)):
                case 0:
                    bad[place % len(bad)] ^= 1 << int(rng.integers(8))
                case 1:
                    bad[place : place + 8] = struct.pack("<Q", int(rng.integers(1 << 62)) << 1)
                case 2:
                    bad[place : place + int(rng.integers(1, 40))] = b""
                case _:
                    bad[place : place + 16] = bytes(16)
        path.write_bytes(bad)
        check_prefix(path, samples)


@pytest.mark.parametrize("step", [pytest.param(3, marks=pytest.mark.soak), 13])
def test_a_damaged_byte_is_noticed(step: int, small: tuple[bytes, list[Sample]], tmp_path: Path) -> None:
    content, samples = small
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    with path.open("r+b", buffering=0) as file:
        for place in range(0, len(content), step):
            os.pwrite(file.fileno(), bytes([content[place] ^ 0x40]), place)
            check_prefix(path, samples)
            os.pwrite(file.fileno(), content[place : place + 1], place)


def test_random_damage(small: tuple[bytes, list[Sample]], tmp_path: Path) -> None:
    fuzz(*small, tmp_path / "bad.mcap", rounds=200, seed=1)


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(8))
def test_much_random_damage(small: tuple[bytes, list[Sample]], tmp_path: Path, seed: int) -> None:
    fuzz(*small, tmp_path / "bad.mcap", rounds=5000, seed=seed + 100)


def test_a_killed_recorder_loses_no_more_than_its_last_half_second(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    code = f"""
        import os, signal
        from pathlib import Path
        from robot.recordings.mcap_writer import Recorder
        from robot.sources.source import Sample, SourceDescription
        from tactile.base.types import Odometry, observation
        recorder = Recorder(Path({str(path)!r}), SourceDescription((3, 6, 1)))
        for i in range(25):
            recorder.write(Sample(0.1 * i, observation(Odometry(0.01, 0, 0, 0.1)), None))
        os.kill(os.getpid(), signal.SIGKILL)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], cwd=Path(__file__).parents[3], check=False
    )
    assert done.returncode == -signal.SIGKILL
    source = Recording(path)
    assert 20 <= source.length <= 25
    assert source.truncated
    ends = f"it ends without its closing record; all {source.length} samples are there that were written"
    assert source.warning == f"{path}: {ends}"
    path.write_bytes(path.read_bytes()[:-1])  # cut in the middle of a message
    assert "the rest is lost: it ends too early" in Recording(path).warning
