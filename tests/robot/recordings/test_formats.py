"""Recordings of every format: how they open, bit-identical round trips, recovery, damage, refused input."""

import os
import re
import signal
import struct
import subprocess
import sys
import textwrap
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from zstandard import FRAME_HEADER as ZSTD_MAGIC

from robot.recordings import cdr
from robot.recordings.formats import FORMATS, open_recording
from robot.recordings.input_judge import InputJudge
from robot.recordings.mcap_reader import FORMAT, McapScanner, Recording, metadata_checksum
from robot.recordings.mcap_writer import Recorder, recover
from robot.recordings.recording_config import RecordingConfig
from robot.sources.input_files import read_bytes
from robot.sources.source import SOURCES, Sample, Source, SourceEntry, SourceInfo
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk, observation
from tests.helpers.distributions import install
from tests.helpers.live import ROOT
from tests.helpers.ros_bags import odometry, write_bag
from tests.robot.conftest import bits
from tests.robot.recordings.conftest import INFO, LIKE, SHAPE, WHISKERS, some_samples, spoilt, write_recording


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_that_cannot_be_opened_is_refused(suffix, tmp_path, refused):
    path = tmp_path / f"run{suffix}"
    attempt = partial(open_recording, RecordingConfig(file=path))
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
    denied = Mock(side_effect=PermissionError(13, "Permission denied", str(path)))
    monkeypatch.setattr(Path, "open", denied)
    refused(lambda: read_bytes(path), str(path), "(Permission denied)", "readable for this user")


def test_parts_of_a_recording_lie_in_the_folder_or_beside_it(tmp_path, monkeypatch):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "aces_scans.csv").touch()
    files = {"views": "*_scans.csv", "pairs": "b.csv", "truth": "/c.csv", "labels": None}
    parts = {"table": {name: {"file": file} for name, file in files.items()}}
    config = RecordingConfig.model_validate({"file": "data/aces_odom.csv"} | parts)
    monkeypatch.chdir(tmp_path)
    for folder, here in ((tmp_path, ()), (Path("/other"), [("recording", "file")])):
        found = config.resolved(folder, here, ("recording",))
        assert found.file == tmp_path / "data" / "aces_odom.csv"
        found = [getattr(found.table, name).file for name in files]
        assert found == [tmp_path / "data" / "aces_scans.csv", folder / "b.csv", Path("/c.csv"), None]


def test_the_readme_example_runs(tmp_path):
    text = (ROOT / "robot" / "recordings" / "README.md").read_text()
    content = re.search(r"```\n(t,vx,.*?)```", text, re.S)
    settings = re.search(r"```yaml\n(.*?)```", text, re.S)
    (tmp_path / "run.csv").write_text(content[1])
    (tmp_path / "truth.csv").write_text("t,x,y,heading\n0,0,0,0\n0.6,0.1,0,0\n")
    config = RecordingConfig.model_validate(yaml.safe_load(settings[1])["recording"]).resolved(tmp_path)
    samples = list(open_recording(config))
    assert samples[2].reading.view.ravel().tolist() == pytest.approx([0.9 / 8, (2.9 + 8) / 16, 1.7 / 8])
    assert [sample.truth is None for sample in samples] == [False, False, True]


@pytest.fixture
def dots(monkeypatch, tmp_path):
    opened = lambda config, warn: SimpleNamespace(length=config.file.read_text().count("."))  # noqa: E731
    SOURCES.register("dots", SourceEntry(RecordingConfig, opened, (".dots",)))
    install(tmp_path / "site", "broken", "import nothing_there", {"ratslam.sources:broken": "broken:ENTRY"})
    monkeypatch.syspath_prepend(tmp_path / "site")
    path = tmp_path / "walk.DOTS"
    path.write_text("...")
    yield path
    SOURCES.unregister("dots")


def test_a_registered_format_opens_by_its_suffix_and_an_unknown_one_names_the_others(dots, refused):
    assert open_recording(RecordingConfig(file=dots)).length == 3
    broken = "the source 'broken' of broken 1.0 cannot be loaded"
    for name, found in (("run.pcap", "'.pcap' files"), ("run", "a file without a suffix")):
        path = dots.with_name(name)
        path.write_text("?")
        attempt = partial(open_recording, RecordingConfig(file=path))
        refused(attempt, found, ".mcap, .npz, .csv", ".dots", broken)


def check_prefix(path, samples):
    """Checks that a damaged file gives a prefix of the samples or one InputError; returns their number."""
    warnings = []
    try:
        source = Recording(path, InputJudge(warn=warnings.append))
    except InputError as error:
        if str(path) not in str(error):
            raise
        return 0
    read = list(source)
    assert bits(read) == bits(samples[: len(read)])
    assert source.info == INFO.model_copy(update={"raw_whiskers": source.info.raw_whiskers})
    assert (source.length, warnings) == (len(read), [source.warning] if source.truncated else [])
    assert source.truncated or len(read) == len(samples)
    return len(read)


@pytest.mark.parametrize("step", [pytest.param(1, marks=pytest.mark.soak), 31])
def test_a_recording_truncated_at_any_byte_yields_a_prefix(step, tmp_path):
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
def test_a_damaged_byte_is_noticed(step, small, tmp_path):
    content, samples = small
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    with path.open("r+b", buffering=0) as file:
        for place in range(0, len(content), step):
            os.pwrite(file.fileno(), bytes([content[place] ^ 0x40]), place)
            check_prefix(path, samples)
            os.pwrite(file.fileno(), content[place : place + 1], place)


def check_read(path, content, **recording):
    path.write_bytes(content)
    try:
        open_recording(RecordingConfig.model_validate({"file": path} | recording))
    except InputError as error:
        if str(path) not in str(error):
            raise


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.soak) for k in range(100, 108))])
def test_random_damage_of_a_recording(seed, small, tmp_path):
    (content, samples), path, rng = small, tmp_path / "bad.mcap", np.random.default_rng(seed)
    for _ in range(150 if seed == 1 else 5000):
        path.write_bytes(spoilt(content, rng))
        check_prefix(path, samples)


@pytest.mark.parametrize("suffix", [".npz", ".csv", ".bag", ".db3", ".mcap"])
def test_random_damage_of_other_files(suffix, stream, tmp_path):
    recording = {"table": {"velocity": {}}} if suffix == ".csv" else {}
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


def test_a_killed_recorder_loses_no_more_than_its_last_half_second(tmp_path):
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
    assert f"all {source.length} samples are there" in source.warning
    path.write_bytes(path.read_bytes()[:-1])  # cut in the middle of a message
    assert "the rest is lost: it ends too early" in Recording(path).warning


@given(st.integers(1, 12), st.integers(0, 2**32))
def test_written_samples_are_read_back_bit_for_bit(tmp_path_factory, count, seed):
    samples = some_samples(count, seed, extreme=True)
    path = write_recording(tmp_path_factory.getbasetemp() / "law.mcap", samples)
    with Recording(path) as source:
        assert isinstance(source, Source)
        assert bits(samples) == bits(list(source)) == bits(list(source))  # a second iteration
        assert (source.length, source.view_shape, source.whiskers) == (len(samples), SHAPE, WHISKERS)
        assert (source.truncated, source.warning, source.rate_hz) == (False, "", 2.0)
        raw = any(not isinstance(sample.reading, Observation) for sample in samples)
        assert source.info == INFO.model_copy(update={"raw_whiskers": raw})


def test_the_file_depends_on_the_samples_alone(tmp_path):
    paths = [write_recording(tmp_path / f"{k}.mcap", some_samples(9, seed=k // 2)) for k in range(3)]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    one, same, other = (Recording(path).digest for path in paths)
    assert one == same != other


def test_rosbags_reads_every_message_bit_for_bit(tmp_path):
    samples = some_samples(10)
    with AnyReader([write_recording(tmp_path / "a.mcap", samples)]) as reader:
        read = [(connection.msgtype, data, reader.deserialize(data, connection.msgtype))
                for connection, _, data in reader.messages()]  # fmt: skip
        for name, data, message in read:
            assert bytes(reader.typestore.serialize_cdr(message, name)) == data
        topics = ("observation", "cycle", "whisk", "report", "truth")
        assert set(reader.topics) == {f"/ratslam/{name}" for name in topics}
    assert len(read) == len(samples) + sum(sample.truth is not None for sample in samples)
    readings = [part for part in read if part[0] != cdr.TRUTH]
    assert [data for _, data, _ in readings] == [cdr.encode(sample, SHAPE, WHISKERS)[2] for sample in samples]
    for sample, (name, data, message) in zip(samples, readings, strict=True):
        kind, fields = ros_message(sample)
        assert name == kind
        for field, values in fields.items():
            np.testing.assert_array_equal(getattr(message, field), np.ravel(values).squeeze(), field)
        assert bits(cdr.decode(name, data, SHAPE, WHISKERS)) == bits(sample[:2])


def ros_message(sample):
    reading = sample.reading
    found = {"time": sample.time, "dtheta": reading.odometry.dtheta}
    if isinstance(reading, Observation):
        return cdr.OBSERVATION, found | {"view": reading.view, "flags": reading.contact + 2 * ~reading.alive}
    if isinstance(reading, Whisk):
        felt = np.stack([reading.touched, reading.highest, reading.reach], 1)
        flags = reading.alive + 2 * reading.contact + 4 * reading.held
        return cdr.WHISK, found | {"felt": felt, "flags": flags}
    if isinstance(reading, Report):
        return cdr.REPORT, found | {name: getattr(reading, name) for name in ("strain", "motion", "moment")}
    return cdr.CYCLE, found | {"deflection": reading.deflection}


def test_recover_writes_a_complete_file(small, tmp_path):
    content, samples = small
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    cut.write_bytes(content[: len(content) * 2 // 3])
    found = Recording(cut)
    assert recover(cut, whole) == (found.length, "it ends too early")
    again = Recording(whole)
    assert not again.truncated
    assert bits(list(again)) == bits(samples[: found.length])
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


def test_a_file_of_another_format_is_refused(tmp_path, refused):
    path, empty = tmp_path / "other.mcap", tmp_path / "none.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        writer.add_message(writer.register_channel("/odom", "cdr", 0), 0, b"1234", 0)
        writer.finish()
    refused(lambda: Recording(path), str(path), "has no ratslam metadata")
    Recorder(empty, LIKE).close()
    refused(lambda: Recording(empty), "holds no samples", "at least one sample")


def test_a_recorder_refuses_wrong_shapes_and_values(tmp_path, refused):
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
    first, second = Recording(path)
    assert bits(first) == bits(good)
    assert second.reading.label == 3
    assert (second.reading.view == 0.5).all()


def test_impossible_values_in_a_recording_are_refused(tmp_path, refused):
    for change, *pieces in (
        ({"time": 1.0}, "time goes back from 2.0 to 1.0 s", "sort the rows"),
        ({"odometry": Odometry(np.nan, 0.0, 0.0, 0.5)}, "odometry is nan", "finite"),
        ({"odometry": Odometry(0.0, 0.0, 0.0, -0.5)}, "dt -0.5 s", "at least 0 s"),
        ({"view": np.full(SHAPE, np.nan)}, "in the reading is nan", "finite"),
        ({"view": np.full(SHAPE, 200.0)}, "view holds 200.0", "divide them by 255"),
        ({"point": np.full((WHISKERS, 2), np.inf)}, "in the reading is inf"),
        ({"truth": np.full(3, np.nan)}, "truth is nan"),
    ):
        samples = some_samples(10)
        bad = samples[5]
        inner = {} if set(change) <= set(Sample._fields) else {"reading": bad.reading._replace(**change)}
        samples[5] = bad._replace(**inner or change)
        path = write_recording(tmp_path / "bad.mcap", samples)
        refused(partial(Recording, path), str(path), "row 5", *pieces)


def test_a_file_that_changes_while_it_is_read_is_noticed(small, tmp_path, refused):
    path = tmp_path / "a.mcap"
    path.write_bytes(small[0])
    source = Recording(path)
    path.write_bytes(small[0][:700])
    refused(lambda: list(source), "had 9 samples and now has")


def test_a_chunk_of_excessive_size_is_not_decompressed(small, tmp_path):
    bad, path = bytearray(small[0]), tmp_path / "bomb.mcap"
    frame = bad.index(ZSTD_MAGIC)
    bad[frame + 4 : frame + 13] = b"\xe0" + struct.pack("<Q", 1 << 60)
    path.write_bytes(bad)
    scanner = McapScanner(path)
    assert list(scanner) == []
    assert "a chunk of 1152921504606846976 bytes" in scanner.broken


SHAPES = st.sampled_from(["2,3,2", "2,3", "0,1,1", "9999999,9999,9", "a,b,c", "-1,1,1"])
INFOS = st.sampled_from(["{}", "[]", "{", "1", '{"cell_size": -1}', '{"calibration": {"mean": 1}}'])


@given(st.sampled_from(list(cdr.TOPICS)), st.binary(max_size=200), SHAPES, st.integers(-1, 1 << 40), INFOS)
def test_a_valid_file_of_other_messages_is_refused(tmp_path_factory, name, message, shape, whiskers, info):
    path = tmp_path_factory.getbasetemp() / "strange.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        metadata = {"format": FORMAT, "view_shape": shape, "whiskers": str(whiskers), "rate_hz": "1.0",
                    "created_by": "a program", "info": info}  # fmt: skip
        writer.add_metadata("ratslam", metadata | {"crc32": metadata_checksum(metadata)})
        schema = writer.register_schema(name, "ros2msg", cdr.SCHEMAS[name].encode())
        channel = writer.register_channel(cdr.TOPICS[name], "cdr", schema)
        writer.add_message(channel, 0, b"\0\1\0\0" + message, 0)
        writer.finish()
    with pytest.raises(InputError):
        Recording(path)


def test_a_recording_of_another_version_is_refused(tmp_path, refused, monkeypatch):
    path = tmp_path / "old.mcap"
    with monkeypatch.context() as patch:
        patch.setattr("robot.recordings.mcap_reader.FORMAT", "2")
        write_recording(path, some_samples(3))
    refused(lambda: Recording(path), str(path), "its format is '2', this version reads '3'")
    with monkeypatch.context() as patch:
        patch.setitem(cdr.SCHEMAS, cdr.OBSERVATION, cdr.SCHEMAS[cdr.OBSERVATION] + "bool more\n")
        write_recording(path, some_samples(3))
    refused(lambda: Recording(path), str(path), "/ratslam/observation", "with another definition")


def test_source_info_is_stored_before_the_first_sample(tmp_path):
    path = write_recording(tmp_path / "a.mcap", some_samples(2))
    content = path.read_bytes()
    path.write_bytes(content[: content.index(ZSTD_MAGIC)])
    scanner = McapScanner(path)
    assert list(scanner) == []
    assert scanner.description.info == INFO


def test_a_truth_in_degrees_is_refused(tmp_path, refused):
    seen = observation(Odometry(*map(np.float64, (0.05, 0.0, 0.3, 0.5))), view_shape=SHAPE, whiskers=WHISKERS)
    samples = [Sample(0.5 * i, seen, np.array([0, 0, 17.0 * i])) for i in range(40)]
    path = write_recording(tmp_path / "degrees.mcap", samples)
    refused(lambda: Recording(path), str(path), "the truth's heading runs from 0 to 663", "pi/180")
