"""Reads recordings in MCAP from their first byte to their end, or to the first damaged byte.

MCAP's own reader needs the index at the end of the file, which a killed writer did not write. Here records
are read in the order in which they were written: lengths are bounded by the rest of the file, chunks must
match their checksum, and every message must fit its schema and have the next sequence number. So a damaged
file yields exactly a prefix of the written messages.
"""

from __future__ import annotations

import json
import struct
from array import array
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple, cast
from zlib import crc32

import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Header, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk

from robot.drivers.head.decoder import Frames, FrameWindow, assemble_cycle
from robot.recordings import cdr
from robot.recordings.cdr import Event, Malformed, doubts_of
from robot.recordings.input_judge import DEFAULT_JUDGE, InputJudge, MotionTrack, limits_of
from robot.recordings.sanity_checks import clock_errors, first_error, nonfinite_errors, view_errors
from robot.sources.input_files import digest_of, raise_errors, readable, require_file
from robot.sources.source import ClosedSource, Sample, Source, SourceDescription, SourceInfo, rate_of
from tactile.base.bounded import MOST_BYTES
from tactile.base.errors import InputError
from tactile.base.types import Observation, Odometry

# Exceptions of the MCAP and zstd libraries and of this package for damaged bytes.
_DAMAGE_ERRORS = (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError)


class _Unclosed(EndOfFile):
    """The file ends after a whole record, as that of a killed writer does, and not with its closing one."""


class _BoundedFile:
    """A file whose `read` returns exactly the requested bytes or raises `EndOfFile`."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.left = file.seek(0, 2)
        file.seek(0)

    def read(self, size: int) -> bytes:
        if not 0 <= size <= self.left:
            raise EndOfFile
        content = self._file.read(size)
        if len(content) != size:
            raise EndOfFile  # the file shrank meanwhile
        self.left -= size
        return content


def _read_records(file: IO[bytes]) -> Iterator[McapRecord]:
    """All records in order, those in chunks included; raises one of `_DAMAGE_ERRORS`."""
    bounded, left = _BoundedFile(file), -1  # bytes after the last whole record
    reader = StreamReader(cast(Any, bounded), emit_chunks=True, validate_crcs=True)
    try:
        for record in reader.records:
            left = bounded.left
            if isinstance(record, Chunk):
                yield from _open_chunk(record)
            elif not isinstance(record, (Message, Channel, Schema)):  # without a checksum outside a chunk
                yield record
    except EndOfFile as error:
        raise _Unclosed if left == 0 else error from None


def _open_chunk(chunk: Chunk) -> list[McapRecord]:
    """The records in a chunk; raises as `_read_records`."""
    if chunk.compression not in ("zstd", ""):
        raise Malformed(f"a chunk compressed with {chunk.compression!r}")
    size = len(chunk.data)
    if chunk.compression:
        size = max(chunk.uncompressed_size, zstandard.frame_content_size(chunk.data))
    if size > MOST_BYTES:  # ratslam writes 64 kB, or one sample if that is larger
        raise Malformed(f"a chunk of {size} bytes, of at most {MOST_BYTES}")
    if not chunk.uncompressed_crc:
        raise Malformed("a chunk without its checksum")
    return breakup_chunk(chunk, validate_crc=True)


METADATA = "ratslam"
FORMAT = "3"
OURS = "ratslam "  # and the version: the library that wrote a recording
UNCLOSED = "it ends without its closing record"
"""Reason to stop at the end of a file whose writer was killed: all that was written is there."""


def metadata_of(source: Source | SourceDescription, program: str) -> dict[str, str]:
    """The metadata of a recording of a source, written by a program.

    Raises:
        TypeError, ValueError: provenance is not JSON.
    """
    data = {
        "format": FORMAT,
        "view_shape": ",".join(map(str, source.view_shape)),
        "whiskers": str(source.whiskers),
        "rate_hz": repr(source.rate_hz),
        "created_by": program,
        "info": source.info.to_json(),
    }
    return data | {"crc32": metadata_checksum(data)}


def read_metadata(data: Mapping[str, str]) -> SourceDescription:
    """The inverse of `metadata_of`, the program as the name.

    Raises:
        ValueError: metadata that it cannot have written.
    """
    if data.get("format") != FORMAT:
        raise Malformed(f"its format is {data.get('format')!r}, this version reads {FORMAT!r}")
    if data.get("crc32") != metadata_checksum(data):
        raise Malformed("its metadata do not match their checksum")
    try:
        rows, columns, channels = shape = tuple(int(size) for size in data["view_shape"].split(","))
        whiskers, rate_hz, program = int(data["whiskers"]), float(data["rate_hz"]), data["created_by"]
        info = SourceInfo.from_json(data["info"])
    except KeyError as error:
        raise Malformed(f"its metadata lack {error}") from error
    if min(*shape, whiskers + 1) < 1 or rows * columns * channels + 3 * whiskers > cdr.MAX_NUMBERS:
        raise Malformed(f"views of shape {shape} and {whiskers} whiskers")
    return SourceDescription((rows, columns, channels), whiskers, rate_hz, info, program)


def is_foreign(path: Path) -> bool:
    """Whether an MCAP file was written by another program: without our metadata before the first message, or
    damaged there and not with our name. False for anything else, such as files that do not exist."""
    if not path.is_file():
        return False
    library = OURS
    try:
        with path.open("rb") as file:
            for record in StreamReader(file, emit_chunks=True).records:
                if isinstance(record, Header):
                    library = record.library
                if isinstance(record, Metadata) and record.name == METADATA:
                    return False
                if isinstance(record, (Chunk, Message)):
                    return True
    except (OSError, *_DAMAGE_ERRORS):
        return not library.startswith(OURS)
    return True


MCAP = b"\x89MCAP0\r\n"  # first and last bytes of a file
CONVERT = (
    "give the .bag or .db3 that it was made from, or convert that to ROS 2 messages (profile ros2, cdr) with "
    "`mcap convert` or `rosbags-convert`"
)
"""The cure for messages of another kind than those of ROS 2."""


def container_fault(path: Path) -> tuple[str, str] | None:
    """What is wrong with an MCAP file as a container, and the cure; None for others."""
    if path.is_dir():
        return next(filter(None, map(container_fault, sorted(path.glob("*.mcap")))), None)
    if path.suffix != ".mcap":
        return None
    profile, codes = "", set[str]()
    with path.open("rb") as file:
        with suppress(Exception):  # damage
            for record in StreamReader(file, emit_chunks=True).records:
                if isinstance(record, Header):
                    profile = record.profile or "none"
                for each in _open_chunk(record) if isinstance(record, Chunk) else [record]:
                    if isinstance(each, (Channel, Schema)):
                        codes.add(each.message_encoding if isinstance(each, Channel) else each.encoding)
                if isinstance(record, (Chunk, Message)):
                    break
        file.seek(-min(file.seek(0, 2), len(MCAP)), 2)
        whole = file.read() == MCAP
    if profile and (profile != "ros2" or codes - {"cdr", "ros2msg", "ros2idl", "omgidl", ""}):
        found = f"an MCAP file of profile {profile} with {', '.join(sorted(codes))}, not of ROS 2"
        return f"cannot be read as a bag: {found}", CONVERT
    if whole or not profile:
        return None
    return "cannot be read as a bag: a ROS 2 bag that is cut off", f"`mcap recover {path.name} -o whole.mcap`"


def metadata_checksum(data: Mapping[str, str]) -> str:
    """CRC-32 of all metadata but the checksum itself; MCAP has no checksum outside chunks."""
    return str(crc32(json.dumps({**data, "crc32": ""}, sort_keys=True).encode()))


class RecordingEntry(NamedTuple):
    """One entry of a recording. Attributes: name: its schema. time: s, of the reading or of the newest part
    of a block. message: the encoded message. truth: the encoded truth of a reading, or None. content: the
    decoded message: a sample, frames of a head, arm states [N], or an event."""

    name: str
    time: float
    message: bytes
    truth: bytes | None
    content: Sample | Frames | np.ndarray | Event


class McapScanner:
    """One pass over a file: iterate once, over its samples or over all its `entries`.

    Attributes:
        description: the metadata, None until they have been read.
        broken: the reason to stop before the end of the file, '' at its end.
        count: samples read so far.
    """

    _frames: FrameWindow

    def __init__(self, path: Path) -> None:
        self.path = path
        self.description: SourceDescription | None = None
        self.broken = "it has not been read to its end"
        self.count = 0
        self._number = 0  # next message; a truth has the number of its reading

    def __iter__(self) -> Iterator[Sample]:
        return (entry.content for entry in self.entries() if isinstance(entry.content, Sample))

    def entries(self) -> Iterator[RecordingEntry]:
        """All samples and other entries, in their order."""
        with readable(self.path), self.path.open("rb") as file:
            yield from self._entries(file)

    def _entries(self, file: IO[bytes]) -> Iterator[RecordingEntry]:
        schemas: dict[int, Schema] = {}
        names: dict[int, str] = {}  # schema of each channel; '': not a ratslam topic
        truth: tuple[bytes, np.ndarray] | None = None
        try:
            for record in _read_records(file):
                if isinstance(record, Metadata) and record.name == METADATA and self.description is None:
                    self.description = read_metadata(record.metadata)
                    self._frames = FrameWindow(self.description.whiskers)
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    names[record.id] = _schema_of(record, schemas) if record.topic in cdr.SCHEMA_OF else ""
                elif isinstance(record, Message):
                    name = names.get(record.channel_id, "")
                    if not name:
                        continue
                    if self.description is None:
                        raise Malformed("a message before the metadata")
                    if record.sequence != self._number % (1 << 32):
                        raise Malformed(f"message {record.sequence} where {self._number} was expected")
                    if name == cdr.TRUTH:
                        truth = record.data, self._decoded(name, record.data)[1]
                        continue
                    self._number += 1
                    time, content = self._decoded(name, record.data)
                    if name not in cdr.READINGS:
                        yield RecordingEntry(name, time, record.data, None, content)
                        continue
                    self.count += 1
                    message, pose = truth or (None, None)
                    yield RecordingEntry(name, time, record.data, message, Sample(time, content, pose))
                    truth = None
                elif isinstance(record, Statistics):
                    self._check_counts(record, names)
        except _DAMAGE_ERRORS as error:
            text = str(error) or type(error).__name__
            self.broken = "it ends too early" if isinstance(error, EndOfFile) else text
            self.broken = UNCLOSED if isinstance(error, _Unclosed) and truth is None else self.broken
        else:
            self.broken = ""

    def _decoded(self, name: str, message: bytes) -> tuple[float, Any]:
        """The time and the content of a message with this schema; of a cut its cycle."""
        assert self.description is not None
        time, content = cdr.decode(name, message, self.description.view_shape, self.description.whiskers)
        if name == cdr.FRAMES:
            self._frames.add(content)
        if name == cdr.CUT:
            content = assemble_cycle(self._frames.between(content.first, content.last), content)
        return time, content

    def _check_counts(self, statistics: Statistics, names: Mapping[int, str]) -> None:
        """Compare counts, since a chunk with a damaged type is skipped as an unknown record."""
        counts = statistics.channel_message_counts
        others = {channel for channel, name in names.items() if name in ("", cdr.TRUTH)}
        written = sum(count for channel, count in counts.items() if channel not in others)
        if written != self._number:
            raise Malformed(f"{self._number} messages where {written} were written")

    def unreadable_error(self) -> InputError:
        """The error for a file without a description or without samples, after its scan."""
        foreign = is_foreign(self.path)
        if foreign and (fault := container_fault(self.path)):
            return InputError(str(self.path), fault[0], "a recording of ratslam", fault[1])
        if self.description is None:
            found = f"cannot be read as a recording: {self.broken or 'it has no ratslam metadata'}"
            cure = "`python -m ratslam doctor` says what it is" if foreign else "record it again"
            return InputError(str(self.path), found, "an MCAP file written by this version of ratslam", cure)
        found, cure = f"holds no samples{': ' + self.broken if self.broken else ''}", "record it again"
        return InputError(str(self.path), found, "at least one sample", f"{cure}: nothing can be recovered")


def _schema_of(channel: Channel, schemas: Mapping[int, Schema]) -> str:
    """The schema name of a ratslam topic; raises `Malformed` if another version defined it differently."""
    name, schema = cdr.SCHEMA_OF[channel.topic], schemas.get(channel.schema_id)
    if schema is None or schema.data != cdr.SCHEMAS[name].encode():
        raise Malformed(f"messages on {channel.topic} with another definition than this version's")
    return name


class Recording(ClosedSource):
    """An MCAP recording as a `Source`. All samples are checked first; iteration then reads them one by one,
    so that raw recordings larger than the memory can be replayed.

    Args:
        path: an `.mcap` file written by `Recorder`, complete or not.
        judge: is told if the file is truncated or damaged.

    Attributes:
        truncated: whether the file ends early; its first `length` samples are readable.
        warning: that sentence, or ''.
        events: events of a live session: faults, discontinuities, dropped images.
        begins: numbers of samples, from 0, to which no odometry leads: each begins a piece of the map.
        info: devices, world and origin, as stored; `raw_whiskers` is set from the readings.

    Raises:
        InputError: the file is missing, has no readable sample, or has impossible values.
    """

    whiskers: int
    view_shape: tuple[int, int, int]

    def __init__(self, path: Path, judge: InputJudge = DEFAULT_JUDGE) -> None:
        require_file(path)
        self.path = path
        self.name = path.stem
        self.digest = digest_of([path])
        scanner = McapScanner(path)
        columns = array("d")
        events, begins = list[Event](), set[int]()
        raw_whiskers = False
        for entry in scanner.entries():
            if isinstance(entry.content, Sample):
                columns.extend(_checked_values(entry.content))
                raw_whiskers |= not isinstance(entry.content.reading, Observation)
            elif isinstance(entry.content, Event):
                events.append(entry.content)
                if entry.content.name == cdr.PIECE:
                    begins.add(scanner.count)
        description = scanner.description
        if description is None or not scanner.count:
            raise scanner.unreadable_error()
        self.events = tuple(events)
        self.view_shape, self.whiskers = description.view_shape, description.whiskers
        self.info = description.info.model_copy(update={"raw_whiskers": raw_whiskers})
        count, self.truncated, self.warning = scanner.count, bool(scanner.broken), ""
        if scanner.broken == UNCLOSED:
            self.warning = f"{path}: {UNCLOSED}; all {count} samples are there that were written"
        elif self.truncated:
            self.warning = f"{path}: {count} samples are readable, the rest is lost: {scanner.broken}"
        rows = np.frombuffer(columns).reshape(count, -1)
        inside = judge.stretch.rows(rows[:, 0], str(path))
        self._first, self._last = int(inside.argmax()), len(inside) - int(inside[::-1].argmax())
        self.length = self._last - self._first
        self.begins = frozenset(n - self._first for n in begins if self._first < n < self._last)
        self.digest = judge.stretch.digest(self.digest)
        time = self._check_columns(rows[self._first : self._last], judge)
        self.rate_hz = rate_of(time) or description.rate_hz
        for sentence in ([self.warning] if self.truncated else []) + doubts_of(events):
            judge.say(sentence)

    def _check_columns(self, columns: np.ndarray, judge: InputJudge) -> np.ndarray:
        """Times [N] s of the samples with odometry; raises the errors of all columns."""
        time, motion, truth = columns[:, 0], columns[:, 1:5], columns[:, 5:8]
        low, high, odd, has_truth = columns[:, 8:].T
        moved = (motion != 0).any(axis=1)
        moved[0] = True  # the first row sets the clock

        def place(row: int) -> str:
            return f"{self.path}, row {row + self._first}"

        errors = nonfinite_errors(time, "time", place) + clock_errors(time, "time", place, moved)
        errors += nonfinite_errors(motion, "odometry", place, most=1e6)
        errors += view_errors(low, high, "view", place)
        errors += nonfinite_errors(odd, "a number in the reading", place)
        errors += nonfinite_errors(truth, "truth", place, has_truth > 0)
        dt = motion[:, 3]
        errors += first_error(dt < 0, place, lambda row: f"odometry has dt {dt[row]} s", "at least 0 s")
        track = MotionTrack(time, moved, motion, truth if has_truth.any() else None)
        judge = replace(judge, limits=limits_of(self.info.interval, judge.limits))
        raise_errors(errors + judge.errors(track, place, str(self.path), in_order=not errors))
        return time[moved]

    def __iter__(self) -> Iterator[Sample]:
        scanner, still = McapScanner(self.path), Odometry(0.0, 0.0, 0.0, 0.0)
        for number, sample in enumerate(scanner):
            if number == self._first > 0:  # it begins here
                yield sample._replace(reading=sample.reading._replace(odometry=still))
            elif number >= self._first:
                yield sample
            if scanner.count == self._last:
                return
        found = f"had {self._last} samples and now has {scanner.count}"
        raise InputError(str(self.path), found, "a file that does not change while it is read")


def _checked_values(sample: Sample) -> tuple[float, ...]:
    """The checked columns of a sample: time, odometry, truth, smallest and largest view value, one non-finite
    number or 0, and whether there is a truth."""
    reading = sample.reading
    truth = (np.nan,) * 3 if sample.truth is None else sample.truth
    low = high = np.nan
    if isinstance(reading, Observation) and reading.view_seen:
        low, high = reading.view.min(), reading.view.max()
    parts = [part for value in reading._replace(odometry=0) if (part := np.asarray(value)).dtype.kind == "f"]
    odd = next((float(part[~good].flat[0]) for part in parts if not (good := np.isfinite(part)).all()), 0.0)
    return (sample.time, *reading.odometry, *truth, low, high, odd, sample.truth is not None)
