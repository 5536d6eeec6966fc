"""Opening recordings: one reader per suffix, and errors for unreadable files."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from pydantic import ValidationError

from robot.recordings.csv_config import (
    CsvConfig,
    PairColumns,
    TruthColumns,
    VelocityColumns,
    ViewColumns,
)
from robot.recordings.formats import FORMATS, open_recording
from robot.recordings.mcap_writer import record_source
from robot.recordings.recording_config import RecordingConfig
from robot.sources.input_files import read_bytes
from robot.sources.source import SOURCES, Source, SourceEntry
from tactile.base.errors import InputError
from tactile.base.settings import Settings
from tests.helpers.distributions import install

ROOT = Path(__file__).parents[3]
Refused = Callable[..., InputError]


def test_every_format_opens_as_a_source(stream: Callable[..., Path], tmp_path: Path) -> None:
    config = RecordingConfig(file=stream())
    with open_recording(config) as source:
        record_source(source, tmp_path / "copy.MCAP")
        (tmp_path / "odometry.csv").write_text("t,vx,w\n0,0.1,0\n0.5,0.1,0\n")
        table = CsvConfig(velocity=VelocityColumns())
        others = [
            open_recording(RecordingConfig(file=tmp_path / "copy.MCAP")),
            open_recording(RecordingConfig(file=tmp_path / "odometry.csv", table=table)),
        ]
        for opened in (source, *others):
            assert isinstance(opened, Source)
            assert opened.rate_hz == 2.0
            assert len(opened.digest) == 64
            assert opened.length == len(list(opened)) == len(list(opened))


def test_a_truncated_recording_warns(stream: Callable[..., Path], tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    with open_recording(RecordingConfig(file=stream())) as source:
        record_source(source, path)
    path.write_bytes(path.read_bytes()[:-300])
    warnings: list[str] = []
    opened = open_recording(RecordingConfig(file=path), warnings.append)
    assert warnings == [f"{path}: {opened.length} samples are readable, the rest is lost: it ends too early"]


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


def test_a_file_in_a_missing_folder_is_refused(tmp_path: Path, refused: Refused) -> None:
    refused(lambda: read_bytes(tmp_path / "no" / "run.csv"), "no such file", "the folder", "does not exist")


def test_a_file_without_permission_is_refused(
    tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.csv"
    path.write_text("t,vx,w\n0,0,0\n")

    def denied(self: Path, *_: object) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "open", denied)
    refused(
        lambda: read_bytes(path), str(path), "cannot be read (Permission denied)", "readable for this user"
    )


def test_an_unknown_format_is_refused(tmp_path: Path, refused: Refused) -> None:
    for name, piece in (("run.pcap", "no reader for '.pcap' files"), ("run", "a file without a suffix")):
        (tmp_path / name).write_text("x")
        refused(
            lambda name=name: open_recording(RecordingConfig(file=tmp_path / name)),
            piece,
            ".mcap, .npz, .csv, .bag, .db3",
        )


def test_relative_paths_are_taken_from_a_folder() -> None:
    table = CsvConfig(
        views=ViewColumns(), pairs=PairColumns(file=Path("b.csv")), truth=TruthColumns(file=Path("/c.csv"))
    )
    config = RecordingConfig(file=Path("a.csv"), table=table).resolved(Path("/data"))
    assert config.file == Path("/data/a.csv")
    assert config.table.pairs is not None
    assert config.table.truth is not None
    assert config.table.views is not None
    assert config.table.pairs.file == Path("/data/b.csv")
    assert config.table.truth.file == Path("/c.csv")
    assert config.table.views.file is None


def test_every_setting_is_described() -> None:
    schema = RecordingConfig.model_json_schema()
    for model in (schema, *schema["$defs"].values()):
        for name, field in model["properties"].items():
            assert field.get("description"), f"{model['title']}.{name}"
    with pytest.raises(ValidationError):
        RecordingConfig.model_validate({"file": "a.csv", "tabel": {}})


def test_the_readme_example_runs(tmp_path: Path) -> None:
    text = (ROOT / "robot" / "recordings" / "README.md").read_text()
    content = re.search(r"```\n(t,vx,.*?)```", text, re.S)
    settings = re.search(r"```yaml\n(.*?)```", text, re.S)
    assert content is not None
    assert settings is not None
    (tmp_path / "run.csv").write_text(content[1])
    (tmp_path / "truth.csv").write_text("t,x,y,heading\n0,0,0,0\n0.6,0.1,0,0\n")
    config = RecordingConfig.model_validate(yaml.safe_load(settings[1])["recording"]).resolved(tmp_path)
    samples = list(open_recording(config))
    assert samples[2].reading.view.ravel().tolist() == pytest.approx([0.9 / 8, (2.9 + 8) / 16, 1.7 / 8])
    assert [sample.truth is None for sample in samples] == [False, False, True]


def test_configuring_imports_no_reader() -> None:
    code = (
        "import sys, robot.recordings.formats;"
        "heavy = {'mcap', 'zstandard', 'scipy', 'jax', 'ratslam'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.soak
def test_a_recording_of_13838_rows_opens_quickly(reference_data: Path, tmp_path: Path) -> None:
    """Generous limits for a busy machine (measured: 0.1 and 0.6 s)."""
    file = reference_data / "traces" / "f_real_tuc_lecture_hall.npz"
    start = time.perf_counter()
    source = open_recording(RecordingConfig(file=file))
    assert sum(1 for _ in source) == 13_838
    assert time.perf_counter() - start < 1
    record_source(source, tmp_path / "copy.mcap")
    start = time.perf_counter()
    assert sum(1 for _ in open_recording(RecordingConfig(file=tmp_path / "copy.mcap"))) == 13_838
    assert time.perf_counter() - start < 4


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


def test_an_unknown_suffix_names_the_formats_and_the_broken_packages(dots: Path) -> None:
    other = dots.with_suffix(".other")
    other.write_text("?")
    with pytest.raises(
        InputError, match=r"one of .*\.dots; the source 'broken' of broken 1\.0 cannot be loaded"
    ):
        open_recording(RecordingConfig(file=other))
