"""MCAP recordings: bit-identical round trips, truncated and damaged files, other tools, refused input."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from robot.recordings.cdr import decode, encode
from robot.recordings.mcap_reader import Recording, record_source, recover
from robot.recordings.mcap_scanner import FORMAT, McapScanner, metadata_checksum
from robot.recordings.npz_trace import read_trace
from robot.recordings.recorder import Recorder
from robot.recordings.schemas import CYCLE, OBSERVATION, REPORT, SCHEMAS, TOPICS, TRUTH, WHISK
from robot.sources.source import Sample, Source
from robot.sources.source_info import MazeInfo, SourceInfo
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Observation, Odometry, Report, Whisk, observation
from tactile.features.calibration import Calibration
from tactile.whiskers.head_geometry import HeadConfig

SHAPE, WHISKERS = (2, 3, 2), 4
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of a compressed chunk."""
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


def numbers(
    *shape: int, low: float | None = None, high: float | None = None
) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, shape, elements=st.floats(low, high, allow_nan=False, allow_infinity=False))


def flags_of(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.bool_, shape)


ODOMETRIES = st.tuples(*[st.floats(-0.1, 0.1).map(np.float64)] * 3, st.just(np.float64(0.5))).map(
    lambda values: Odometry(*values)
)
OBSERVATIONS = st.builds(
    Observation,
    odometry=ODOMETRIES,
    motion=st.integers(0, 3).map(np.int32),
    view=numbers(*SHAPE, low=0, high=1),
    view_seen=st.booleans().map(np.bool_),
    label=st.integers(-1, 2**31 - 1).map(np.int32),
    contact=flags_of(WHISKERS),
    alive=flags_of(WHISKERS),
    point=numbers(WHISKERS, 2),
    wall=st.booleans().map(np.bool_),
    wall_point=numbers(2),
    wall_sd=NUMBERS.map(np.float64),
)
CYCLES = st.integers(0, 5).flatmap(
    lambda t: st.builds(
        Cycle,
        time=numbers(t),
        angle=numbers(t, WHISKERS),
        deflection=numbers(t, WHISKERS, 2),
        odometry=ODOMETRIES,
    )
)
WHISKS = st.builds(
    Whisk,
    odometry=ODOMETRIES,
    alive=flags_of(WHISKERS),
    contact=flags_of(WHISKERS),
    touched=numbers(WHISKERS),
    held=flags_of(WHISKERS),
    highest=numbers(WHISKERS),
    reach=numbers(WHISKERS),
)
REPORTS = st.integers(0, 5).flatmap(
    lambda t: st.builds(
        Report,
        odometry=ODOMETRIES,
        motion=st.integers(0, 3),
        moment=st.integers(0, 3),
        alive=flags_of(WHISKERS),
        contact=flags_of(WHISKERS),
        time=numbers(t),
        strain=numbers(t, WHISKERS, 2),
    )
)
INFO = SourceInfo(
    raw_whiskers=True,
    head=HeadConfig(rest_deg=74.0),
    calibration=Calibration(
        mean=np.zeros((2, 2)),
        sd=np.array([[1e-3, 0.1], [1e-300, -0.0]]),
        threshold=np.array([[np.inf, 1 / 3], [0.1, 5e-324]]),
        free=np.array([0.7, 0.0]),
        alive=np.array([True, False]),
        rate=2000.0,
    ),
    maze=MazeInfo(text="o---o\n|   |\no---o\n", heights=(0.05, 0.02), seed=3),
    provenance={"über": None, "numbers": [0.1, -0.0]},
)
TRUTHS = st.none() | numbers(3, low=-0.1, high=0.1)
SAMPLES = st.lists(st.tuples(OBSERVATIONS | CYCLES | WHISKS | REPORTS, TRUTHS), min_size=1, max_size=12).map(
    lambda parts: [Sample(100 + 0.5 * i, *part) for i, part in enumerate(parts)]
)


def leaves(sample: Sample) -> list[Any]:
    parts: list[Any] = [np.float64(sample.time), type(sample.reading), sample.truth is None]
    odometry = sample.reading.odometry
    rest = sample.reading._replace(odometry=None)
    return [*parts, *odometry, *(part for part in rest if part is not None), sample.truth]


def same_bits(one: Sequence[Sample], other: Sequence[Sample]) -> bool:
    """Whether two sequences of samples are equal in every bit, shape and dtype."""

    def key(value: Any) -> Any:
        if isinstance(value, (np.ndarray, np.generic)):
            return np.asarray(value).tobytes(), np.shape(value), np.asarray(value).dtype
        return value

    return len(one) == len(other) and all(
        list(map(key, leaves(a))) == list(map(key, leaves(b))) for a, b in zip(one, other, strict=True)
    )


def write_recording(path: Path, samples: Sequence[Sample], **options: Any) -> Path:
    path.unlink(missing_ok=True)
    options = {"info": INFO} | options
    with Recorder(path, view_shape=SHAPE, whiskers=WHISKERS, rate_hz=2.0, **options) as recorder:
        for sample in samples:
            recorder.write(sample)
    return path


def some_samples(count: int, seed: int = 0) -> list[Sample]:
    """Samples of all kinds with every field filled."""
    rng = np.random.default_rng(seed)
    samples = []
    for i in range(count):
        odometry = Odometry(*(np.float64(x) for x in (*rng.normal(0, 0.05, 3), 0.5)))
        truth = rng.normal(size=3) if i % 3 else None
        if i % 5 == 4:
            flags, strain = rng.random((2, WHISKERS)) < 0.5, rng.normal(size=(3, WHISKERS, 2))
            report = Report(odometry, 1, 2, *flags, time=np.arange(3) / 2000, strain=strain)
            samples.append(Sample(0.5 * i, report, truth))
        elif i % 4 == 3:
            arrays_ = (rng.random(2), rng.normal(size=(2, WHISKERS)), rng.normal(size=(2, WHISKERS, 2)))
            samples.append(Sample(0.5 * i, Cycle(*arrays_, odometry), truth))
        elif i % 4 == 2:
            truths, numbers = rng.random((3, WHISKERS)) < 0.5, rng.normal(size=(3, WHISKERS))
            whisk = Whisk(odometry, truths[0], truths[1], numbers[0], truths[2], *numbers[1:])
            samples.append(Sample(0.5 * i, whisk, truth))
        else:
            seen = observation(odometry, rng.random(SHAPE), label=i, whiskers=WHISKERS)
            point = rng.normal(size=(WHISKERS, 2))
            seen = seen._replace(point=point, contact=point[:, 0] > 0, alive=point[:, 1] > 0)
            samples.append(Sample(0.5 * i, seen, truth))
    return samples


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[bytes, list[Sample]]:
    """A small recording of several chunks: its bytes and its samples."""
    samples = some_samples(9)
    path = write_recording(tmp_path_factory.mktemp("small") / "small.mcap", samples, chunk_s=1.5)
    return path.read_bytes(), samples


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


def check_prefix(path: Path, samples: list[Sample]) -> int:
    """Checks that a damaged file gives a prefix of the samples or one InputError; returns their number."""
    warnings: list[str] = []
    source: Recording | None
    try:
        source = Recording(path, warn=warnings.append)
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


def test_a_recording_truncated_at_any_byte_yields_a_prefix(tmp_path: Path) -> None:
    """The least number of samples with several chunks and every kind of reading."""
    samples = some_samples(5)
    assert {type(sample.reading) for sample in samples} == {Observation, Whisk, Cycle, Report}
    path = write_recording(tmp_path / "cut.mcap", samples, chunk_s=1.0)
    content = path.read_bytes()
    assert content.count(ZSTD_MAGIC) == 3
    counts = []
    for size in reversed(range(len(content))):
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


def test_a_damaged_byte_is_noticed(small: tuple[bytes, list[Sample]], tmp_path: Path) -> None:
    content, samples = small
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    with path.open("r+b", buffering=0) as file:
        for place in range(0, len(content), 3):
            os.pwrite(file.fileno(), bytes([content[place] ^ 0x40]), place)
            check_prefix(path, samples)
            os.pwrite(file.fileno(), content[place : place + 1], place)


def test_random_damage(small: tuple[bytes, list[Sample]], tmp_path: Path) -> None:
    fuzz(*small, tmp_path / "bad.mcap", rounds=500, seed=1)


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(8))
def test_much_random_damage(small: tuple[bytes, list[Sample]], tmp_path: Path, seed: int) -> None:
    fuzz(*small, tmp_path / "bad.mcap", rounds=5000, seed=seed + 100)


def test_a_killed_recorder_loses_no_more_than_its_last_half_second(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    code = f"""
        import os, signal
        from pathlib import Path
        from robot.recordings.recorder import Recorder
        from robot.sources.source import Sample
        from tactile.base.types import Odometry, observation
        recorder = Recorder(Path({str(path)!r}))
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
    assert f"{source.length} samples are readable, the rest is lost: it ends too early" in source.warning


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
    refused(lambda: recover(path, old), str(old), "exists already", "another name")
    refused(lambda: Recorder(old), str(old), "exists already", "another name")
    refused(lambda: Recorder(tmp_path / "no" / "folder.mcap"), "cannot be written")
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
    Recorder(tmp_path / "none.mcap").close()
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
    with Recorder(path, view_shape=SHAPE, whiskers=WHISKERS) as recorder:
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


def test_the_mcap_library_reads_a_recording(small: tuple[bytes, list[Sample]], tmp_path: Path) -> None:
    from mcap.reader import make_reader

    content, samples = small
    (tmp_path / "a.mcap").write_bytes(content)
    with (tmp_path / "a.mcap").open("rb") as file:
        reader = make_reader(file)
        assert [m.metadata["view_shape"] for m in reader.iter_metadata() if m.name == "ratslam"] == ["2,3,2"]
        found = [(schema.encoding, channel.topic) for schema, channel, _ in reader.iter_messages()]
    topics = ("observation", "cycle", "whisk", "report", "truth")
    assert set(found) == {("ros2msg", f"/ratslam/{name}") for name in topics}
    assert len(found) == len(samples) + sum(sample.truth is not None for sample in samples)


def test_rosbags_reads_every_message_bit_for_bit(tmp_path: Path) -> None:
    from rosbags.highlevel import AnyReader

    samples = some_samples(10)
    with AnyReader([write_recording(tmp_path / "a.mcap", samples)]) as reader:
        read = [(connection.msgtype, data, reader.deserialize(data, connection.msgtype))
                for connection, _, data in reader.messages()]  # fmt: skip
        for name, data, message in read:
            assert bytes(reader.typestore.serialize_cdr(message, name)) == data
    readings = [part for part in read if part[0] != TRUTH]
    assert [data for _, data, _ in readings] == [encode(sample, SHAPE, WHISKERS)[1] for sample in samples]
    for sample, (name, data, message) in zip(samples, readings, strict=True):
        check_fields(sample, name, message)
        assert same_bits([Sample(*decode(name, data, SHAPE, WHISKERS), sample.truth)], [sample])


def test_mcap_ros2_reads_every_message(tmp_path: Path) -> None:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    samples = some_samples(10)
    with write_recording(tmp_path / "a.mcap", samples).open("rb") as file:
        read = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    readings = [part for part in read if part.schema.name != TRUTH]
    for sample, part in zip(samples, readings, strict=True):
        check_fields(sample, part.schema.name, part.decoded_message)


def check_fields(sample: Sample, name: str, message: Any) -> None:
    """A ROS tool's message has the values of the sample."""
    reading = sample.reading
    assert (message.time, message.dtheta) == (sample.time, reading.odometry.dtheta)
    if isinstance(reading, Observation):
        assert name == OBSERVATION
        assert (np.reshape(message.view, SHAPE) == reading.view).all()
        assert (np.array(list(message.flags)) == reading.contact + 2 * ~reading.alive).all()
    elif isinstance(reading, Whisk):
        assert name == WHISK
        features = np.stack([reading.touched, reading.highest, reading.reach], 1)
        assert (np.reshape(message.felt, (WHISKERS, 3)) == features).all()
        flags = reading.alive + 2 * reading.contact + 4 * reading.held
        assert (np.array(list(message.flags)) == flags).all()
    elif isinstance(reading, Report):
        assert name == REPORT
        assert (message.motion, message.moment) == (reading.motion, reading.moment)
        assert (np.reshape(message.strain, (-1, WHISKERS, 2)) == reading.strain).all()
    else:
        assert name == CYCLE
        assert (np.reshape(message.deflection, (2, WHISKERS, 2)) == reading.deflection).all()


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
        patch.setattr("robot.recordings.mcap_scanner.FORMAT", "2")
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
        Recorder(tmp_path / "a.mcap", info=SourceInfo(provenance={"a": value}))
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
