"""Recordings of every format: how they open, and damaged ones, of which an error or what is whole remains."""

from __future__ import annotations

import os
import re
import signal
import struct
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from robot.recordings.csv_config import CsvConfig, VelocityColumns
from robot.recordings.formats import FORMATS, open_recording
from robot.recordings.input_judge import InputJudge
from robot.recordings.mcap_reader import Recording
from robot.recordings.mcap_writer import record_source
from robot.recordings.recording_config import RecordingConfig
from robot.sources.input_files import read_bytes
from robot.sources.source import SOURCES, Sample, Source, SourceEntry
from tactile.base.errors import InputError
from tactile.base.settings import Settings
from tactile.base.types import Cycle, Observation, Report, Whisk
from tests.helpers.distributions import install
from tests.helpers.live import ROOT
from tests.helpers.ros_bags import odometry, write_bag
from tests.robot.recordings.conftest import INFO, ZSTD_MAGIC, same_bits, some_samples, write_recording

Refused = Callable[..., InputError]


def test_every_format_opens_as_a_source(stream: Callable[..., Path], tmp_path: Path) -> None:
    config = RecordingConfig(file=stream())
    with open_recording(config) as source:
        record_source(source, tmp_path / "copy.MCAP")
        (tmp_path / "odometry.csv").write_text("t,vx,w\n0,0.1,0\n0.5,0.1,0\n")
        table = CsvConfig(velocity=VelocityColumns())
        for opened in (
            source,
            open_recording(RecordingConfig(file=tmp_path / "copy.MCAP")),
            open_recording(RecordingConfig(file=tmp_path / "odometry.csv", table=table)),
        ):
            assert isinstance(opened, Source)
            assert opened.rate_hz == 2.0
            assert len(opened.digest) == 64
            assert opened.length == len(list(opened)) == len(list(opened))


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_that_cannot_be_opened_is_refused(suffix: str, tmp_path: Path, refused: Refused) -> None:
    path = tmp_path / f"run{suffix}"

    def attempt() -> Source:
        return open_recording(RecordingConfig(file=path))

    refused(attempt, str(path), "no such file")
    (tmp_path / f"ruin{suffix}").touch()
    refused(attempt, f"did you mean 'ruin{suffix}'?")
    path.touch()
    refused(attempt, str(path), "is empty")
    path.write_bytes(b"\x00\xff\xfe nonsense" * 20)
    refused(attempt, str(path))
    path.unlink()
    path.mkdir()
    refused(attempt, str(path), "is a folder", "expected a file")
    path.rmdir()
    os.mkfifo(path)
    refused(attempt, str(path), "is not a regular file")


def test_a_file_in_a_missing_folder_or_without_permission_is_refused(tmp_path, refused, monkeypatch):
    refused(lambda: read_bytes(tmp_path / "no" / "run.csv"), "no such file", "the folder", "does not exist")
    path = tmp_path / "run.csv"
    path.write_text("t,vx,w\n0,0,0\n")

    def denied(self: Path, *_: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", denied)
    refused(lambda: read_bytes(path), str(path), "(Permission denied)", "readable for this user")


def test_relative_paths_are_taken_from_a_folder() -> None:
    files = {"views": {}, "pairs": {"file": "b.csv"}, "truth": {"file": "/c.csv"}}
    config = RecordingConfig.model_validate({"file": "a.csv", "table": files}).resolved(Path("/data"))
    assert config.file == Path("/data/a.csv")
    found = config.table.model_dump()
    assert [found[name]["file"] for name in files] == [None, Path("/data/b.csv"), Path("/c.csv")]


def test_the_readme_example_runs(tmp_path: Path) -> None:
    text = (ROOT / "robot" / "recordings" / "README.md").read_text()
    content = re.search(r"```\n(t,vx,.*?)```", text, re.S)
    settings = re.search(r"```yaml\n(.*?)```", text, re.S)
    (tmp_path / "run.csv").write_text(content[1])
    (tmp_path / "truth.csv").write_text("t,x,y,heading\n0,0,0,0\n0.6,0.1,0,0\n")
    config = RecordingConfig.model_validate(yaml.safe_load(settings[1])["recording"]).resolved(tmp_path)
    samples = list(open_recording(config))
    assert samples[2].reading.view.ravel().tolist() == pytest.approx([0.9 / 8, (2.9 + 8) / 16, 1.7 / 8])
    assert [sample.truth is None for sample in samples] == [False, False, True]


class DotsConfig(Settings):
    """A made-up format: one metre ahead for each dot in the file."""

    file: Path


def open_dots(config: DotsConfig, warn: object) -> Any:
    return SimpleNamespace(length=config.file.read_text().count("."))


@pytest.fixture
def dots(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """A file of the made-up format, beside a package that cannot be loaded."""
    SOURCES.register("dots", SourceEntry(DotsConfig, open_dots, (".dots",)))
    install(tmp_path / "site", "broken", "import nothing_there", {"ratslam.sources:broken": "broken:ENTRY"})
    monkeypatch.syspath_prepend(tmp_path / "site")
    path = tmp_path / "walk.DOTS"
    path.write_text("...")
    yield path
    SOURCES.unregister("dots")


def test_a_registered_format_opens_by_its_suffix(dots: Path) -> None:
    assert open_recording(RecordingConfig(file=dots)).length == 3


@pytest.mark.parametrize("name", ["run.pcap", "run"])
def test_an_unknown_format_names_the_others_and_the_broken_packages(name, dots, refused):
    path = dots.with_name(name)
    path.write_text("?")
    found = "'.pcap' files" if path.suffix else "a file without a suffix"
    broken = "the source 'broken' of broken 1.0 cannot be loaded"
    refused(lambda: open_recording(RecordingConfig(file=path)), found, ".mcap, .npz, .csv", ".dots", broken)


def check_prefix(path: Path, samples: list[Sample]) -> int:
    """Checks that a damaged file gives a prefix of the samples or one InputError; returns their number."""
    warnings: list[str] = []
    source, message = None, str(path)
    try:
        source = Recording(path, InputJudge(warn=warnings.append))
    except InputError as error:
        message = str(error)
    assert str(path) in message
    if source is None:
        return 0
    read = list(source)
    assert same_bits(read, samples[: len(read)])
    assert source.info == INFO.model_copy(update={"raw_whiskers": source.info.raw_whiskers})
    assert source.length == len(read)
    assert warnings == ([source.warning] if source.truncated else [])
    assert source.truncated or len(read) == len(samples)
    return len(read)


@pytest.mark.parametrize("step", [pytest.param(1, marks=pytest.mark.soak), 31])
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


@pytest.mark.parametrize("step", [pytest.param(3, marks=pytest.mark.soak), 41])
def test_a_damaged_byte_is_noticed(step: int, small: tuple[bytes, list[Sample]], tmp_path: Path) -> None:
    content, samples = small
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    with path.open("r+b", buffering=0) as file:
        for place in range(0, len(content), step):
            os.pwrite(file.fileno(), bytes([content[place] ^ 0x40]), place)
            check_prefix(path, samples)
            os.pwrite(file.fileno(), content[place : place + 1], place)


def check_read(path: Path, content: bytes, **recording: Any) -> None:
    """Checks that a damaged file is read, or gives an error that names it."""
    path.write_bytes(content)
    message = str(path)
    try:
        open_recording(RecordingConfig.model_validate({"file": path} | recording))
    except InputError as error:
        message = str(error)
    assert str(path) in message


def spoilt(content: bytes, rng: np.random.Generator) -> bytes:
    """The content with a few bits, bytes and numbers changed, cut out or zeroed."""
    bad = bytearray(content)
    for place in rng.integers(0, len(bad), rng.integers(1, 4)):
        match int(rng.integers(5)):
            case 0:
                bad[place % len(bad)] ^= 1 << int(rng.integers(8))
            case 1:
                bad[place : place + 8] = struct.pack("<Q", int(rng.integers(1 << 62)) << 1)
            case 2:
                bad[place : place + int(rng.integers(1, 40))] = b""
            case 3:
                bad[place : place + 1] = bytes([int(rng.integers(256))])
            case _:
                bad[place : place + 16] = bytes(16)
    return bytes(bad)


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(100, 108))]
)
def test_random_damage_of_a_recording(seed: int, small: tuple[bytes, list[Sample]], tmp_path: Path) -> None:
    (content, samples), path, rng = small, tmp_path / "bad.mcap", np.random.default_rng(seed)
    for _ in range(150 if seed == 1 else 5000):
        path.write_bytes(spoilt(content, rng))
        check_prefix(path, samples)


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".bag", ".db3", ".mcap"])
def test_random_damage_of_other_files(suffix: str, stream: Callable[..., Path], tmp_path: Path) -> None:
    """The last three are bags."""
    recording: dict[str, Any] = {"table": {"velocity": {}}} if suffix == ".csv" else {}
    if suffix == ".npz":
        content = stream().read_bytes()
    elif suffix == ".csv":
        content = b"t,vx,w\n" + b"".join(b"%d,0.1,0.05\n" % t for t in range(40))
    else:
        recording["topics"] = {"odometry": "/odom"}
        kind = {".bag": "ros1", ".db3": "sqlite3", ".mcap": "mcap"}[suffix]
        path = write_bag(tmp_path, kind, [odometry(10**9 + 10**8 * t, 0.01 * t, 0, 0) for t in range(20)])
        content = (path if path.is_file() else path / f"run{suffix}").read_bytes()
    rng = np.random.default_rng(1)
    for _ in range(25 if "topics" in recording else 200):
        check_read(tmp_path / f"bad{suffix}", spoilt(content, rng), **recording)


@given(st.text(max_size=200) | st.binary(max_size=200), st.booleans())
def test_any_text_as_a_table_is_read_or_gives_one_error(tmp_path_factory, text, headed):
    data = text if isinstance(text, bytes) else text.encode("utf-8", "surrogatepass")
    path = tmp_path_factory.getbasetemp() / "any.csv"
    check_read(path, b"t,vx,w\n" * headed + data, table={"velocity": {}})


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
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(code)], cwd=ROOT, check=False)
    assert done.returncode == -signal.SIGKILL
    source = Recording(path)
    assert 20 <= source.length <= 25
    assert source.truncated
    ends = f"it ends without its closing record; all {source.length} samples are there that were written"
    assert source.warning == f"{path}: {ends}"
    path.write_bytes(path.read_bytes()[:-1])  # cut in the middle of a message
    assert "the rest is lost: it ends too early" in Recording(path).warning
