"""Reads a recording in MCAP from its first byte to its end, or to the first damaged byte.

MCAP's own reader needs the index at the end of the file, which a killed writer did not write. Here records
are read in the order in which they were written: lengths are bounded by the rest of the file, chunks must
match their checksum, and every message must fit its schema and have the next sequence number. So a damaged
file yields exactly a prefix of the written messages.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple, cast
from zlib import crc32

import numpy as np
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Header, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk

from robot.drivers.head.decoder import Frames, FrameWindow, assemble_cycle
from robot.recordings.cdr import (
    ARM,
    CUT,
    FRAMES,
    MAX_NUMBERS,
    READINGS,
    SCHEMA_OF,
    SCHEMAS,
    TRUTH,
    Event,
    Malformed,
    decode,
    decode_cut,
    decode_event,
    decode_frames,
    decode_states,
    decode_truth,
)
from robot.sources.input_files import unreadable_error
from robot.sources.source import Sample, SourceInfo
from tactile.base.bounded import MOST_BYTES

# Exceptions of the MCAP and zstd libraries and of this package for damaged bytes.
_DAMAGE_ERRORS = (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError)


class _Unclosed(EndOfFile):
    """The file ends after a whole record, as that of a killed writer does, and not with its closing one."""


class _BoundedFile:
    """A file whose `read` returns exactly the requested bytes or raises `EndOfFile`.

    Attributes:
        left: bytes not read yet.
    """

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
                yield from open_chunk(record)
            elif not isinstance(record, (Message, Channel, Schema)):  # without a checksum outside a chunk
                yield record
    except EndOfFile as error:
        raise _Unclosed if left == 0 else error from None


def open_chunk(chunk: Chunk) -> list[McapRecord]:
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


class RecordingDescription(NamedTuple):
    """The metadata of a recording. Attributes: view_shape: (R, C, K). whiskers: W. rate_hz: nominal rate, 0
    if unknown. created_by: program and version. info: devices, world and origin of the session."""

    view_shape: tuple[int, int, int]
    whiskers: int
    rate_hz: float
    created_by: str
    info: SourceInfo

    def to_metadata(self) -> dict[str, str]:
        """Raises `TypeError` or `ValueError` for provenance that is not JSON."""
        data = {
            "format": FORMAT,
            "view_shape": ",".join(map(str, self.view_shape)),
            "whiskers": str(self.whiskers),
            "rate_hz": repr(self.rate_hz),
            "created_by": self.created_by,
            "info": self.info.to_json(),
        }
        return data | {"crc32": metadata_checksum(data)}

    @classmethod
    def from_metadata(cls, data: Mapping[str, str]) -> RecordingDescription:
        """Raises `ValueError` for metadata that `to_metadata` cannot have written."""
        if data.get("format") != FORMAT:
            raise Malformed(f"its format is {data.get('format')!r}, this version reads {FORMAT!r}")
        if data.get("crc32") != metadata_checksum(data):
            raise Malformed("its metadata do not match their checksum")
        try:
            rows, columns, channels = (int(size) for size in data["view_shape"].split(","))
            whiskers, rate_hz = int(data["whiskers"]), float(data["rate_hz"])
            info = SourceInfo.from_json(data["info"])
            found = cls((rows, columns, channels), whiskers, rate_hz, data["created_by"], info)
        except KeyError as error:
            raise Malformed(f"its metadata lack {error}") from error
        sizes = (*found.view_shape, found.whiskers + 1)
        if min(sizes) < 1 or rows * columns * channels + 3 * found.whiskers > MAX_NUMBERS:
            raise Malformed(f"views of shape {found.view_shape} and {found.whiskers} whiskers")
        return found


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
        self.description: RecordingDescription | None = None
        self.broken = "it has not been read to its end"
        self.count = 0
        self._number = 0  # next message; a truth has the number of its reading

    def __iter__(self) -> Iterator[Sample]:
        return (entry.content for entry in self.entries() if isinstance(entry.content, Sample))

    def entries(self) -> Iterator[RecordingEntry]:
        """All samples and other entries, in their order."""
        try:
            with self.path.open("rb") as file:
                yield from self._entries(file)
        except OSError as error:
            raise unreadable_error(self.path, error) from error

    def _entries(self, file: IO[bytes]) -> Iterator[RecordingEntry]:
        schemas: dict[int, Schema] = {}
        names: dict[int, str] = {}  # schema of each channel; '': not a ratslam topic
        truth: bytes | None = None
        try:
            for record in _read_records(file):
                if isinstance(record, Metadata) and record.name == METADATA and self.description is None:
                    self.description = RecordingDescription.from_metadata(record.metadata)
                    self._frames = FrameWindow(self.description.whiskers)
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    names[record.id] = _schema_of(record, schemas) if record.topic in SCHEMA_OF else ""
                elif isinstance(record, Message):
                    name = names.get(record.channel_id, "")
                    if not name:
                        continue
                    if self.description is None:
                        raise Malformed("a message before the metadata")
                    if record.sequence != self._number % (1 << 32):
                        raise Malformed(f"message {record.sequence} where {self._number} was expected")
                    if name == TRUTH:
                        decode_truth(record.data)
                        truth = record.data
                        continue
                    self._number += 1
                    time, content = self._decoded(name, record.data, truth)
                    reading = name in READINGS
                    self.count += reading
                    yield RecordingEntry(name, time, record.data, truth if reading else None, content)
                    truth = None if reading else truth
                elif isinstance(record, Statistics):
                    self._check_counts(record, names)
        except _DAMAGE_ERRORS as error:
            text = str(error) or type(error).__name__
            self.broken = "it ends too early" if isinstance(error, EndOfFile) else text
            self.broken = UNCLOSED if isinstance(error, _Unclosed) and truth is None else self.broken
        else:
            self.broken = ""

    def _decoded(
        self, name: str, message: bytes, truth: bytes | None
    ) -> tuple[float, Sample | Frames | np.ndarray | Event]:
        """The time and the content of a message with this schema; truth: of a reading."""
        assert self.description is not None
        whiskers = self.description.whiskers
        if name in READINGS:
            where = None if truth is None else decode_truth(truth)[1]
            if name != CUT:
                time, reading = decode(name, message, self.description.view_shape, whiskers)
            else:
                cut = decode_cut(message)
                time, reading = cut.time, assemble_cycle(self._frames.between(cut.first, cut.last), cut)
            return time, Sample(time, reading, where)
        if name == FRAMES:
            time, frames = decode_frames(message, whiskers)
            self._frames.add(frames)
            return time, frames
        if name == ARM:
            return decode_states(message)
        event = decode_event(message)
        return event.time, event

    def _check_counts(self, statistics: Statistics, names: Mapping[int, str]) -> None:
        """Compare counts, since a chunk with a damaged type is skipped as an unknown record."""
        counts = statistics.channel_message_counts
        others = {channel for channel, name in names.items() if name in ("", TRUTH)}
        written = sum(count for channel, count in counts.items() if channel not in others)
        if written != self._number:
            raise Malformed(f"{self._number} messages where {written} were written")


def _schema_of(channel: Channel, schemas: Mapping[int, Schema]) -> str:
    """The schema name of a ratslam topic; raises `Malformed` if another version defined it differently."""
    name, schema = SCHEMA_OF[channel.topic], schemas.get(channel.schema_id)
    if schema is None or schema.data != SCHEMAS[name].encode():
        raise Malformed(f"messages on {channel.topic} with another definition than this version's")
    return name
