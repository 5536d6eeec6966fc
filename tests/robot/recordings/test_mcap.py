"""MCAP recordings: bit-identical round trips, also by other tools; recovery, refused input."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader

from robot.recordings import cdr
from robot.recordings.mcap_reader import FORMAT, McapScanner, Recording, metadata_checksum
from robot.recordings.mcap_writer import Recorder, record_source, recover
from robot.recordings.npz_trace import read_trace
from robot.sources.source import Sample, Source, SourceInfo
from tactile.base.errors import InputError
from tactile.base.types import Observation, Odometry, Report, Whisk, observation
from tests.robot.recordings.conftest import (
    INFO,
    LIKE,
    SHAPE,
    WHISKERS,
    ZSTD_MAGIC,
    same_bits,
    some_samples,
    write_recording,
)

Refused = Callable[..., InputError]


@given(st.integers(1, 12), st.integers(0, 2**32))
def test_written_samples_are_read_back_bit_for_bit(tmp_path_factory: Any, count: int, seed: int) -> None:
    samples = some_samples(count, seed, extreme=True)
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
    paths = [write_recording(tmp_path / f"{k}.mcap", some_samples(9, seed=k // 2)) for k in range(3)]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    one, same, other = (Recording(path).digest for path in paths)
    assert one == same != other
    assert len(one) == 64


def test_a_recorded_source_equals_the_source(find_trace: Callable[[str], Path], tmp_path: Path) -> None:
    with read_trace(find_trace("a_square3")) as source:
        assert record_source(source, tmp_path / "copy.mcap") == source.length
        record_source(Recording(tmp_path / "copy.mcap"), tmp_path / "again.mcap")
        for name in ("copy", "again"):
            copy = Recording(tmp_path / f"{name}.mcap")
            assert same_bits(list(copy), list(source))
            assert (copy.rate_hz, copy.info) == (source.rate_hz, source.info)


def test_the_mcap_library_reads_a_recording(small: tuple[bytes, list[Sample]]) -> None:
    content, samples = small
    reader = make_reader(BytesIO(content))
    assert [m.metadata["view_shape"] for m in reader.iter_metadata() if m.name == "ratslam"] == ["2,3,2"]
    found = [(schema.encoding, channel.topic) for schema, channel, _ in reader.iter_messages()]
    topics = ("observation", "cycle", "whisk", "report", "truth")
    assert set(found) == {("ros2msg", f"/ratslam/{name}") for name in topics}
    assert len(found) == len(samples) + sum(sample.truth is not None for sample in samples)


def test_rosbags_reads_every_message_bit_for_bit(tmp_path: Path) -> None:
    samples = some_samples(10)
    with AnyReader([write_recording(tmp_path / "a.mcap", samples)]) as reader:
        read = [(connection.msgtype, data, reader.deserialize(data, connection.msgtype))
                for connection, _, data in reader.messages()]  # fmt: skip
        for name, data, message in read:
            assert bytes(reader.typestore.serialize_cdr(message, name)) == data
    readings = [part for part in read if part[0] != cdr.TRUTH]
    assert [data for _, data, _ in readings] == [cdr.encode(sample, SHAPE, WHISKERS)[2] for sample in samples]
    for sample, (name, data, message) in zip(samples, readings, strict=True):
        check_fields(sample, name, message)
        assert same_bits([Sample(*cdr.decode(name, data, SHAPE, WHISKERS), sample.truth)], [sample])


def check_fields(sample: Sample, name: str, message: Any) -> None:
    """A ROS tool's message has the values of the sample."""
    reading = sample.reading
    assert (message.time, message.dtheta) == (sample.time, reading.odometry.dtheta)
    if isinstance(reading, Observation):
        kind, flags = cdr.OBSERVATION, reading.contact + 2 * ~reading.alive
        pairs = [(message.view, reading.view), (message.flags, flags)]
    elif isinstance(reading, Whisk):
        kind, flags = cdr.WHISK, reading.alive + 2 * reading.contact + 4 * reading.held
        features = np.stack([reading.touched, reading.highest, reading.reach], 1)
        pairs = [(message.felt, features), (message.flags, flags)]
    elif isinstance(reading, Report):
        kind, pairs = cdr.REPORT, [(message.strain, reading.strain)]
        assert (message.motion, message.moment) == (reading.motion, reading.moment)
    else:
        kind, pairs = cdr.CYCLE, [(message.deflection, reading.deflection)]
    assert name == kind
    assert all((np.asarray(found) == wanted.ravel()).all() for found, wanted in pairs)


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


def test_recorders_and_recoveries_leave_other_files_alone(small, tmp_path, refused):
    path, old, bad = (tmp_path / f"{name}.mcap" for name in ("a", "old", "bad"))
    path.write_bytes(small[0])
    old.write_bytes(b"precious")
    bad.write_bytes(b"not a recording")
    refused(lambda: recover(path, old), str(old), "exists already", "another")
    refused(lambda: Recorder(old, LIKE), str(old), "exists already", "another")
    refused(lambda: Recorder(tmp_path / "no" / "folder.mcap", LIKE), "cannot be written")
    refused(lambda: recover(bad, tmp_path / "out.mcap"), "cannot be read as a recording")
    for value in (np.nan, object(), np.zeros(2)):  # not JSON
        with pytest.raises((ValueError, TypeError)):
            Recorder(tmp_path / "new.mcap", replace(LIKE, info=SourceInfo(provenance={"a": value})))
    assert old.read_bytes() == b"precious"
    assert sorted(tmp_path.iterdir()) == [path, bad, old]


def test_a_file_of_another_format_is_refused(tmp_path: Path, refused: Refused) -> None:
    path, empty = tmp_path / "other.mcap", tmp_path / "none.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        writer.add_message(writer.register_channel("/odom", "cdr", 0), 0, b"1234", 0)
        writer.finish()
    refused(lambda: Recording(path), str(path), "has no ratslam metadata")
    Recorder(empty, LIKE).close()
    refused(lambda: Recording(empty), "holds no samples", "at least one sample")


def test_a_recorder_refuses_wrong_shapes_and_values(tmp_path: Path, refused: Refused) -> None:
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
def test_impossible_values_in_a_recording_are_refused(change, pieces, tmp_path, refused):
    samples = some_samples(10)
    (key,), bad = change, samples[5]
    outer = change if key in Sample._fields else {"reading": bad.reading._replace(**change)}
    samples[5] = bad._replace(**outer)
    path = write_recording(tmp_path / "bad.mcap", samples)
    refused(lambda: Recording(path), str(path), *pieces)


def test_a_file_that_changes_while_it_is_read_is_noticed(small, tmp_path, refused):
    path = tmp_path / "a.mcap"
    path.write_bytes(small[0])
    source = Recording(path)
    path.write_bytes(small[0][:700])
    refused(lambda: list(source), "had 9 samples and now has")


def test_a_chunk_of_excessive_size_is_not_decompressed(small, tmp_path):
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
    st.sampled_from(list(cdr.TOPICS)),
    st.binary(max_size=200),
    st.sampled_from(["2,3,2", "2,3", "0,1,1", "9999999,9999,9", "a,b,c", "-1,1,1"]),
    st.integers(-1, 1 << 40),
    st.sampled_from(["{}", "[]", "{", "1", '{"cell_size": -1}', '{"calibration": {"mean": 1}}']),
)
def test_a_valid_mcap_file_with_other_messages_is_refused(
    tmp_path_factory: Any, name: str, message: bytes, shape: str, whiskers: int, info: str
) -> None:
    """Checksums are right, but the contents are not those of a recording."""
    path = tmp_path_factory.getbasetemp() / "strange.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        metadata = {"format": FORMAT, "view_shape": shape, "whiskers": str(whiskers), "rate_hz": "1.0"}
        metadata |= {"created_by": "a program", "info": info}
        writer.add_metadata("ratslam", metadata | {"crc32": metadata_checksum(metadata)})
        schema = writer.register_schema(name, "ros2msg", cdr.SCHEMAS[name].encode())
        writer.add_message(
            writer.register_channel(cdr.TOPICS[name], "cdr", schema), 0, b"\0\1\0\0" + message, 0
        )
        writer.finish()
    with pytest.raises(InputError):
        Recording(path)


def test_a_recording_of_another_version_is_refused(tmp_path, refused, monkeypatch):
    old = tmp_path / "old.mcap"
    with monkeypatch.context() as patch:
        patch.setattr("robot.recordings.mcap_reader.FORMAT", "2")
        write_recording(old, some_samples(3))
    refused(lambda: Recording(old), str(old), "its format is '2', this version reads '3'")
    other = tmp_path / "other.mcap"
    with monkeypatch.context() as patch:
        patch.setitem(cdr.SCHEMAS, cdr.OBSERVATION, cdr.SCHEMAS[cdr.OBSERVATION] + "bool more\n")
        write_recording(other, some_samples(3))
    refused(lambda: Recording(other), str(other), "/ratslam/observation", "with another definition")


def test_source_info_is_stored_before_the_first_sample(tmp_path: Path) -> None:
    """A recorder killed at once leaves a file with its source info."""
    path = write_recording(tmp_path / "a.mcap", some_samples(2))
    content = path.read_bytes()
    path.write_bytes(content[: content.index(ZSTD_MAGIC)])
    scanner = McapScanner(path)
    assert list(scanner) == []
    assert scanner.description.info == INFO


def test_a_truth_in_degrees_is_refused(tmp_path: Path, refused: Refused) -> None:
    """All readers share the check of units, see test_input_judge.py."""
    seen = observation(Odometry(*map(np.float64, (0.05, 0.0, 0.3, 0.5))), view_shape=SHAPE, whiskers=WHISKERS)
    samples = [Sample(0.5 * i, seen, np.array([0, 0, 17.0 * i])) for i in range(40)]
    path = write_recording(tmp_path / "degrees.mcap", samples)
    refused(lambda: Recording(path), str(path), "the truth's heading runs from 0 to 663", "pi/180")
