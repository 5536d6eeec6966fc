"""The records of an MCAP file in the order in which they were written, checked against damage.

MCAP's own reader needs the index at the end of the file, which a killed writer did not write. Lengths are
bounded by the rest of the file, and chunks must match their checksum.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import IO, Any, cast

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk

from robot.recordings.cdr import Malformed
from tactile.base.bounded import MOST_BYTES

# Exceptions of the MCAP and zstd libraries and of this package for damaged bytes.
DAMAGE_ERRORS = (McapError, zstandard.ZstdError, struct.error, ValueError, OverflowError)


class Unclosed(EndOfFile):
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


def read_records(file: IO[bytes]) -> Iterator[McapRecord]:
    """All records in order, those in chunks included; raises one of `DAMAGE_ERRORS`."""
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
        raise Unclosed if left == 0 else error from None


def open_chunk(chunk: Chunk) -> list[McapRecord]:
    """The records in a chunk; raises as `read_records`."""
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
