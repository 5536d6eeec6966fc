"""Reading a recording from its first byte to its last, or to the first that is broken.

MCAP's own reader wants the table of contents at the end, which a killed writer never wrote. Here records are
taken in the order they were written. Nothing a damaged file says is believed: lengths are bounded by what is
left of the file, chunks must have their checksum, and samples their number in the sequence, so what is read
is exactly a prefix of what was written.
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
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema, Statistics
from mcap.stream_reader import StreamReader, breakup_chunk

from robot.files import unreadable
from robot.messages import (
    CYCLE,
    MOST,
    OBSERVATION,
    REPORT,
    SCHEMAS,
    TRUTH,
    WHISK,
    Malformed,
    decode,
    decode_truth,
)
from robot.source import Sample

METADATA = "ratslam"
FORMAT = "2"
TOPICS = {
    OBSERVATION: "/ratslam/observation",
    CYCLE: "/ratslam/cycle",
    WHISK: "/ratslam/whisk",
    REPORT: "/ratslam/report",
    TRUTH: "/ratslam/truth",
}
SCHEMA_OF = {topic: name for name, topic in TOPICS.items()}
CHUNK_LIMIT = 1 << 28  # bytes; ours hold 64 kB, or one sample if that is larger

# What the MCAP and zstd libraries, and we, raise about bytes that are not what they should be.
_BROKEN = (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError)


class Description(NamedTuple):
    """What a recording says about itself before its first sample.

    Attributes:
        view_shape: (R, C, K). whiskers: W. rate_hz: as announced by who recorded it, 0 if unknown.
        created_by: program and version.
        rig: a JSON document about the robot that was recorded (see `robot.source.Rigged`).
    """

    view_shape: tuple[int, int, int]
    whiskers: int
    rate_hz: float
    created_by: str
    rig: Mapping[str, Any] = {}

    def to_metadata(self) -> dict[str, str]:
        """Raises `ValueError` for a rig that JSON cannot hold."""
        data = {
            "format": FORMAT,
            "view_shape": ",".join(map(str, self.view_shape)),
            "whiskers": str(self.whiskers),
            "rate_hz": repr(self.rate_hz),
            "created_by": self.created_by,
            "rig": json.dumps(self.rig, allow_nan=False, sort_keys=True),
        }
        return data | {"crc32": _checksum(data)}

    @classmethod
    def from_metadata(cls, data: Mapping[str, str]) -> Description:
        """Raises `ValueError` for anything `to_metadata` cannot have written."""
        if data.get("format") != FORMAT:
            raise Malformed(f"format {data.get('format')!r} where {FORMAT!r} is the one known")
        if data.get("crc32") != _checksum(data):
            raise Malformed("a description without its checksum")
        try:
            rows, columns, channels = (int(size) for size in data["view_shape"].split(","))
            whiskers, rate_hz, rig = int(data["whiskers"]), float(data["rate_hz"]), json.loads(data["rig"])
            found = cls((rows, columns, channels), whiskers, rate_hz, data["created_by"], rig)
        except KeyError as error:
            raise Malformed(f"a description without {error}") from error
        sizes = (*found.view_shape, found.whiskers + 1)
        if min(sizes) < 1 or rows * columns * channels + 3 * found.whiskers > MOST:
            raise Malformed(f"views of shape {found.view_shape} and {found.whiskers} whiskers")
        if not isinstance(rig, dict):
            raise Malformed("a rig that is no document")
        return found


def _checksum(data: Mapping[str, str]) -> str:
    """Of all of a description but the checksum; outside chunks, MCAP itself has none."""
    return str(crc32(json.dumps({**data, "crc32": ""}, sort_keys=True).encode()))


class Walk:
    """One pass over a file; iterate once.

    Attributes:
        description: None until the file's has been read.
        broken: why the walk ended before the file's proper end; '' if it did not.
        count: samples so far.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.description: Description | None = None
        self.broken = "it was not read to its end"
        self.count = 0

    def __iter__(self) -> Iterator[Sample]:
        try:
            with self.path.open("rb") as file:
                yield from self._samples(file)
        except OSError as error:
            raise unreadable(self.path, error) from error

    def _samples(self, file: IO[bytes]) -> Iterator[Sample]:
        schemas: dict[int, Schema] = {}
        names: dict[int, str] = {}
        truth: tuple[float, np.ndarray] | None = None
        try:
            for record in _records(file):
                if isinstance(record, Metadata) and record.name == METADATA and self.description is None:
                    self.description = Description.from_metadata(record.metadata)
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    if record.topic in SCHEMA_OF:
                        names[record.id] = _known(record, schemas)
                elif isinstance(record, Message) and record.channel_id in names:
                    name = names[record.channel_id]
                    if self.description is None:
                        raise Malformed("a sample before the recording's description")
                    if record.sequence != self.count % (1 << 32):
                        raise Malformed(f"sample {record.sequence} where {self.count} was due")
                    if name == TRUTH:
                        truth = decode_truth(record.data)
                        continue
                    time, reading = decode(
                        name, record.data, self.description.view_shape, self.description.whiskers
                    )
                    sample = Sample(time, reading, truth[1] if truth is not None else None)
                    truth = None
                    self.count += 1
                    yield sample
                elif isinstance(record, Statistics):
                    self._compare(record, names)
        except _BROKEN as error:
            self.broken = (
                "it ends too early" if isinstance(error, EndOfFile) else str(error) or type(error).__name__
            )
        else:
            self.broken = ""

    def _compare(self, statistics: Statistics, names: Mapping[int, str]) -> None:
        """A chunk whose very type is damaged is passed over as unknown: then the numbers differ."""
        counts = statistics.channel_message_counts
        written = sum(counts.get(number, 0) for number, name in names.items() if name != TRUTH)
        if written != self.count:
            raise Malformed(f"{self.count} samples where {written} were written")


def _known(channel: Channel, schemas: Mapping[int, Schema]) -> str:
    """The schema of a topic of ours; raises `Malformed` for one that other versions wrote."""
    name, schema = SCHEMA_OF[channel.topic], schemas.get(channel.schema_id)
    if schema is None or schema.data != SCHEMAS[name].encode():
        raise Malformed(f"messages on {channel.topic} that are defined otherwise than here")
    return name


class _Bounded:
    """A file that neither pretends to be longer than it is nor hands out half of what was asked for."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._left = file.seek(0, 2)
        file.seek(0)

    def read(self, size: int) -> bytes:
        if not 0 <= size <= self._left:
            raise EndOfFile
        content = self._file.read(size)
        if len(content) != size:
            raise EndOfFile  # it shrank while we read
        self._left -= size
        return content


def _records(file: IO[bytes]) -> Iterator[McapRecord]:
    """Every record in order, chunks opened; raises one of `_BROKEN`."""
    reader = StreamReader(cast(Any, _Bounded(file)), emit_chunks=True, validate_crcs=True)
    for record in reader.records:
        if isinstance(record, Chunk):
            yield from _opened(record)
        elif not isinstance(record, (Message, Channel, Schema)):  # outside a chunk they have no checksum
            yield record


def _opened(chunk: Chunk) -> list[McapRecord]:
    if chunk.compression not in ("zstd", ""):
        raise Malformed(f"a chunk compressed with {chunk.compression!r}")
    size = len(chunk.data)
    if chunk.compression:
        size = max(chunk.uncompressed_size, zstandard.frame_content_size(chunk.data))
    if size > CHUNK_LIMIT:
        raise Malformed(f"a chunk of {size} bytes")
    if not chunk.uncompressed_crc:
        raise Malformed("a chunk without its checksum")
    return breakup_chunk(chunk, validate_crc=True)
