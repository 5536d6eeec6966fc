"""MCAP recordings: bit-identical round trips, recovery, refused input."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot.recordings.cdr import OBSERVATION, SCHEMAS, TOPICS
from robot.recordings.mcap_reader import FORMAT, McapScanner, Recording, metadata_checksum
from robot.recordings.mcap_writer import Recorder, record_source, recover
from robot.recordings.npz_trace import read_trace
from robot.sources.source import Sample, Source, SourceInfo
from tactile.base.errors import InputError
from tactile.base.types import Observation, Odometry, observation
from tests.robot.recordings.mcap_samples import (
    INFO,
    LIKE,
    SAMPLES,
    SHAPE,
    WHISKERS,
    ZSTD_MAGIC,
    same_bits,
    some_samples,
    write_recording,
)


@settings(max_examples=60)
@given(SAMPLES)
def test_written_samples_are_read_back_bit_for_bit(tmp_path_factory: Any, samples: list[Sample]) -> None:
    path = write_recording(tmp_path_factory.getbasetemp() / "law.mcap", samples)
    with Recording(path) as source:
        assert isinstance(source, Source)
        assert same_bits(list(source), samples)
        assert same_bits(list(source), samples)  # a second iteration
        assert (source.length, source.view_shape, source.whiskers) == (len(samples), SHAPE, WHISKERS)
        assert (source.truncated, source.warning, source.rate_hz) == (False, "", 2.0)
        raw = any(not isinstance(sample.reading, Observation) for sample in samples)
        assert source.info == INFO.model_copy(update={"raw_whiskers": raw})


def test_the_file_depends_on_the_samples_alone(tmp_path: Path) -> None:
    paths = [write_recording(tmp_path / name, some_samples(9)) for name in ("a.mcap", "b.mcap")]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    sources = [Recording(path) for path in paths]
    assert sources[0].digest == sources[1].digest
    assert len(sources[0].digest) == 64
    assert (
        Recording(write_recording(tmp_path / "c.mcap", some_samples(9, seed=1))).digest != sources[0].digest
    )


def test_a_recorded_source_equals_the_source(trace: Path, tmp_path: Path) -> None:
    with read_trace(trace) as source:
        assert record_source(source, tmp_path / "copy.mcap") == source.length
        copy = Recording(tmp_path / "copy.mcap")
        assert same_bits(list(copy), list(source))
        assert copy.rate_hz == source.rate_hz


def test_recover_writes_a_complete_file(small: tuple[bytes, list[Sample]], tmp_path: Path) -> None:
    content, samples = small
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    cut.write_bytes(content[: len(content) * 2 // 3])
    found = Recording(cut)
    report = recover(cut, whole)
    assert report == (found.length, "it ends too early")
    again = Recording(whole)
    assert not again.truncated
    assert same_bits(list(again), samples[: found.length])
    assert (again.view_shape, again.whiskers, again.info) == (SHAPE, WHISKERS, INFO)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cut.mcap", "whole.mcap"]
    assert recover(whole, tmp_path / "third.mcap") == (found.length, "")


def test_existing_files_are_not_overwritten(
    small: tuple[bytes, list[Sample]], tmp_path: Path, refused: Callable[..., InputError]
) -> None:
    path, old = tmp_path / "a.mcap", tmp_path / "old.mcap"
    path.write_bytes(small[0])
    old.write_bytes(b"precious")
    refused(lambda: recover(path, old), str(old), "exists already", "another")
    refused(lambda: Recorder(old, LIKE), str(old), "exists already", "another")
    refused(lambda: Recorder(tmp_path / "no" / "folder.mcap", LIKE), "cannot be written")
    assert old.read_bytes() == b"precious"


def test_a_failed_recovery_leaves_no_file(tmp_path: Path, refused: Callable[..., InputError]) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"not a recording")
    refused(lambda: recover(tmp_path / "bad.mcap", tmp_path / "out.mcap"), "cannot be read as a recording")
    assert [path.name for path in tmp_path.iterdir()] == ["bad.mcap"]


def test_a_file_of_another_format_is_refused(tmp_path: Path, refused: Callable[..., InputError]) -> None:
    from mcap.writer import Writer

    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        writer.add_message(writer.register_channel("/odom", "cdr", 0), 0, b"1234", 0)
        writer.finish()
    refused(
        lambda: Recording(path), str(path), "has no ratslam metadata", "written by this version of ratslam"
    )
    Recorder(tmp_path / "none.mcap", LIKE).close()
    refused(lambda: Recording(tmp_path / "none.mcap"), "holds no samples", "at least one sample")


def test_a_recorder_refuses_wrong_shapes_and_values(
    tmp_path: Path, refused: Callable[..., InputError]
) -> None:
    good = some_samples(1)[0]
    path = tmp_path / "a.mcap"
    wrong = {
        "view: shape [1, 1, 1]; expected [2, 3, 2]": {"view": np.zeros((1, 1, 1))},
        "label: int64 values; expected values that int32 holds": {"label": np.int64(2**40)},
        "label: float64 values": {"label": 1.5},
        "view: complex128 values": {"view": np.zeros(SHAPE, complex)},
        "contact: int64 values; expected values that bool holds": {"contact": np.array([0, 1, 2, 0])},
        "alive: shape [3]; expected [4]": {"alive": np.ones(3, bool)},
    }
    with Recorder(path, LIKE) as recorder:
        for piece, change in wrong.items():
            bad = good._replace(reading=good.reading._replace(**change))
            refused(lambda bad=bad: recorder.write(bad), piece)
        refused(lambda: recorder.write(good._replace(time=np.nan)), "time: nan")
        refused(lambda: recorder.write(good._replace(truth=np.zeros(2))), "truth: shape [2]", "[3]")
        recorder.write(good)
        narrow = good.reading._replace(view=np.full(SHAPE, 0.5, np.float32), label=3)
        recorder.write(good._replace(time=0.5, reading=narrow))
    samples = list(Recording(path))
    assert same_bits(samples[:1], [good])
    assert samples[1].reading.label == 3
    assert (samples[1].reading.view == 0.5).all()


@pytest.mark.parametrize(
    ("change", "pieces"),
    {
        "backwards": ({"time": 1.0}, ["row 5", "time goes back from 2.0 to 1.0 s", "sort the rows"]),
        "repeated": ({"time": 2.0}, ["row 5", "time repeats 2.0 s", "drop the repeated rows"]),
        "odometry": ({"odometry": Odometry(np.nan, 0.0, 0.0, 0.5)}, ["row 5", "odometry is nan", "finite"]),
        "negative": ({"odometry": Odometry(0.0, 0.0, 0.0, -0.5)}, ["row 5", "dt -0.5 s", "at least 0 s"]),
        "view": ({"view": np.full(SHAPE, np.nan)}, ["row 5", "in the reading is nan", "finite"]),
        "bytes": ({"view": np.full(SHAPE, 200.0)}, ["row 5", "view holds 200.0", "divide them by 255"]),
        "point": ({"point": np.full((WHISKERS, 2), np.inf)}, ["row 5", "in the reading is inf"]),
        "truth": ({"truth": np.full(3, np.nan)}, ["row 5", "truth is nan"]),
    }.values(),
)  # fmt: skip
def test_impossible_values_in_a_recording_are_refused(
    change: dict[str, Any], pieces: list[str], tmp_path: Path, refused: Callable[..., InputError]
) -> None:
    samples = some_samples(10)
    outer = {key: change[key] for key in change if key in Sample._fields}
    inner = {key: change[key] for key in change if key not in outer}
    bad = samples[5]
    samples[5] = bad._replace(reading=bad.reading._replace(**inner), **outer)
    path = write_recording(tmp_path / "bad.mcap", samples)
    refused(lambda: Recording(path), str(path), *pieces)


def test_a_file_that_changes_while_it_is_read_is_noticed(
    small: tuple[bytes, list[Sample]], tmp_path: Path, refused: Callable[..., InputError]
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(small[0])
    source = Recording(path)
    path.write_bytes(small[0][:700])
    refused(lambda: list(source), "had 9 samples and now has")


def test_a_chunk_of_excessive_size_is_not_decompressed(
    small: tuple[bytes, list[Sample]], tmp_path: Path
) -> None:
    """A frame header states 2^60 bytes; they are not allocated."""
    content, _ = small
    frame = content.index(ZSTD_MAGIC)
    bad = bytearray(content)
    bad[frame + 4 : frame + 13] = b"\xe0" + struct.pack("<Q", 1 << 60)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(bad)
    scanner = McapScanner(path)
    assert list(scanner) == []
    assert "a chunk of 1152921504606846976 bytes" in scanner.broken


@given(
    st.sampled_from(list(TOPICS)),
    st.binary(max_size=200),
    st.sampled_from(["2,3,2", "2,3", "0,1,1", "9999999,9999,9", "a,b,c", "-1,1,1"]),
    st.integers(-1, 1 << 40),
    st.sampled_from(["{}", "[]", "{", "1", '{"cell_size": -1}', '{"calibration": {"mean": 1}}']),
)
def test_a_valid_mcap_file_with_other_messages_is_refused(
    tmp_path_factory: Any, name: str, message: bytes, shape: str, whiskers: int, info: str
) -> None:
    """Checksums are right, but the contents are not those of a recording."""
    from mcap.writer import Writer

    path = tmp_path_factory.getbasetemp() / "strange.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        metadata = {"format": FORMAT, "view_shape": shape, "whiskers": str(whiskers), "rate_hz": "1.0"}
        metadata |= {"created_by": "a program", "info": info}
        writer.add_metadata("ratslam", metadata | {"crc32": metadata_checksum(metadata)})
        schema = writer.register_schema(name, "ros2msg", SCHEMAS[name].encode())
        writer.add_message(writer.register_channel(TOPICS[name], "cdr", schema), 0, b"\0\1\0\0" + message, 0)
        writer.finish()
    with pytest.raises(InputError):
        Recording(path)


def test_a_recording_of_another_version_is_refused(
    tmp_path: Path, refused: Callable[..., InputError], monkeypatch: pytest.MonkeyPatch
) -> None:
    old = tmp_path / "old.mcap"
    with monkeypatch.context() as patch:
        patch.setattr("robot.recordings.mcap_reader.FORMAT", "2")
        write_recording(old, some_samples(3))
    refused(lambda: Recording(old), str(old), "its format is '2', this version reads '3'")
    other = tmp_path / "other.mcap"
    with monkeypatch.context() as patch:
        patch.setitem(SCHEMAS, OBSERVATION, SCHEMAS[OBSERVATION] + "bool more\n")
        write_recording(other, some_samples(3))
    refused(lambda: Recording(other), str(other), "/ratslam/observation", "with another definition")


@pytest.mark.parametrize("value", [np.nan, object(), np.zeros(2)])
def test_provenance_that_is_not_json_is_refused_before_a_file_is_written(tmp_path: Path, value: Any) -> None:
    with pytest.raises((ValueError, TypeError)):
        Recorder(tmp_path / "a.mcap", replace(LIKE, info=SourceInfo(provenance={"a": value})))
    assert not (tmp_path / "a.mcap").exists()


def test_source_info_is_stored_before_the_first_sample(tmp_path: Path) -> None:
    """A recorder killed at once leaves a file with its source info."""
    path = write_recording(tmp_path / "a.mcap", some_samples(2))
    content = path.read_bytes()
    path.write_bytes(content[: content.index(ZSTD_MAGIC)])
    scanner = McapScanner(path)
    assert list(scanner) == []
    assert scanner.description is not None
    assert scanner.description.info == INFO


def test_a_copy_of_a_recording_keeps_the_source_info(
    find_trace: Callable[[str], Path], tmp_path: Path
) -> None:
    plain = read_trace(find_trace("a_square3"))
    assert plain.info.cell_size == 0.1
    assert not plain.info.labels_only
    record_source(plain, tmp_path / "a.mcap")
    record_source(Recording(tmp_path / "a.mcap"), tmp_path / "b.mcap")
    assert Recording(tmp_path / "b.mcap").info == plain.info


def test_a_truth_in_degrees_is_refused(tmp_path: Path, refused: Callable[..., InputError]) -> None:
    """All readers share the unit check (see test_unit_check)."""
    turning = Odometry(*(np.float64(value) for value in (0.05, 0.0, 0.3, 0.5)))
    samples = [
        Sample(0.5 * i, observation(turning, view_shape=SHAPE, whiskers=WHISKERS), np.array([0, 0, 17.0 * i]))
        for i in range(40)
    ]
    path = write_recording(tmp_path / "degrees.mcap", samples)
    refused(lambda: Recording(path), str(path), "the truth's heading runs from 0 to 663", "pi/180")
