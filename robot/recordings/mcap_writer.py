"""Writes recordings as MCAP files that stay readable when the process is killed or the disk is full; copies
sources to recordings, and recovers truncated ones.

Chunks are zstd-compressed, have checksums, and reach the operating system as a whole.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, suppress
from importlib.metadata import PackageNotFoundError, version
from itertools import chain
from pathlib import Path
from typing import Any, cast

import numpy as np
from mcap.writer import CompressionType, Writer

from robot.drivers.head.decoder import Cut, Frames
from robot.recordings.cdr import READINGS, SCHEMAS, TOPICS, TRUTH, Event, encode, encode_truth
from robot.recordings.mcap_reader import METADATA, McapScanner, metadata_of, read_metadata
from robot.sources.input_files import require_file
from robot.sources.source import Sample, Source, SourceDescription
from tactile.base.errors import InputError
from tactile.base.files import flush_to_disk, make_new_file, require_new_file

_CHUNK_BYTES = 1 << 16
"""Size of a chunk before compression."""


class RecordingWriteError(InputError):
    """The operating system refuses to write to a recording."""

    def __init__(self, path: Path, error: OSError) -> None:
        cure = "free space on the disk; the file is readable up to here"
        super().__init__(str(path), f"cannot be written any further ({error.strerror or error})", "", cure)


class MessageWriter:
    """Writes messages of other programs in CDR, as any bag has them."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}

    def add(self, topic: str, kind: str, definition: str, time: int, content: bytes) -> None:
        """Adds a message.

        Args:
            kind: its type, which `definition` defines in the text of ROS 2. time: of its arrival, ns.
        """
        if topic not in self._channels:
            schema = self._writer.register_schema(kind, "ros2msg", definition.encode())
            self._channels[topic] = self._writer.register_channel(topic, "cdr", schema)
        self._writer.add_message(self._channels[topic], time, content, time)


class Recorder(AbstractContextManager["Recorder"]):
    """Writes a new file; a context manager.

    Args:
        path: must not exist yet.
        source: has the view shape and number of whiskers of every sample, a nominal rate, and devices, world
            and origin; stored at the start of the file, so that a truncated one has them.
        chunk_s: a chunk is written when it has `_CHUNK_BYTES`, or when the time of its last message differs
            from that of the previous chunk by this many seconds.

    Attributes:
        count: readings written so far.

    Raises:
        InputError: the file exists or cannot be created.
        ValueError, TypeError: provenance of the source is not JSON.
    """

    def __init__(self, path: Path, source: Source | SourceDescription, chunk_s: float = 0.5) -> None:
        metadata = metadata_of(source, _program())
        read_metadata(metadata)
        self.path, self._sizes = path, (source.view_shape, source.whiskers)
        try:
            self._file = WholeChunkFile(path)
        except FileExistsError:
            require_new_file(path)  # says what is there
            raise
        except OSError as error:
            raise InputError(str(path), f"cannot be written ({error.strerror})") from error
        self._chunk_s = chunk_s
        self._pending, self._flushed = 0, -np.inf  # bytes in the open chunk; time of the last closed one
        self._channels: dict[str, int] = {}
        self.count = 0
        self._number = 0
        self._failed = False
        # Chunks are ended here, never by the library, so that each one reaches the operating system whole.
        file = cast(Any, self._file)
        self._writer = Writer(file, 1 << 62, compression=CompressionType.ZSTD, enable_data_crcs=True)
        self._others = MessageWriter(self._writer)
        self._writer.start(profile="ros2", library=_program())
        self._writer.add_metadata(METADATA, metadata)
        self.flush()

    def write(
        self,
        content: Sample | Cut | Frames | np.ndarray | Event,
        truth: np.ndarray | None = None,
        arrival: float = np.nan,
    ) -> None:
        """Append a sample with its truth, or what a live session records (see `encode`).

        Args:
            truth: [3] of a cut. arrival: of frames, when the newest of them came, s.

        Raises:
            InputError: a shape, dtype or time that the recording cannot hold (nothing is written then), or
                the disk is full.
        """
        if isinstance(content, Sample):
            truth = content.truth
            if not np.isfinite(content.time):
                raise InputError("time", f"{content.time}", "a finite number of seconds")
        name, time, message = encode(content, *self._sizes, arrival)
        if truth is not None:  # written first, so that no truncated file has a reading without it
            self.append(TRUTH, time, encode_truth(time, truth))
        self.append(name, time, message)

    def append(self, name: str, time: float, message: bytes) -> None:
        """Append an encoded message with that schema; the truth of a reading precedes it."""
        # MCAP's clock has no negative times.
        stamp = min(max(round(time * 1e9), 0), (1 << 63) - 1) if np.isfinite(time) else 0
        if name not in self._channels:
            schema = self._writer.register_schema(name, "ros2msg", SCHEMAS[name].encode())
            self._channels[name] = self._writer.register_channel(TOPICS[name], "cdr", schema)
        self._writer.add_message(self._channels[name], stamp, message, stamp, self._number % (1 << 32))
        self._pending += len(message)
        if name == TRUTH:
            return
        self._number += 1
        self.count += name in READINGS
        if self._pending >= _CHUNK_BYTES or abs(time - self._flushed) >= self._chunk_s:
            self.flush()
            self._flushed = time

    def append_message(self, topic: str, kind: str, definition: str, time: int, content: bytes) -> None:
        """Append a message of another program; see `MessageWriter.add`."""
        self._others.add(topic, kind, definition, time, content)
        self._pending += len(content)
        if self._pending >= _CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hand all messages so far to the operating system."""
        try:
            self._writer.flush()
        except OSError as error:
            self._failed = True
            raise RecordingWriteError(self.path, error) from error
        self._pending = 0

    def close(self) -> None:
        """Finish the file; may be called again. Data refused before are tried once more, without an error.

        Raises:
            RecordingWriteError: the operating system refuses to write the rest.
        """
        if self._file.closed:
            return
        try:
            self._writer.finish()
            self._file.flush()
        except OSError as error:
            if not self._failed:
                raise RecordingWriteError(self.path, error) from error
        finally:
            self._file.close()

    def __exit__(self, *error: object) -> None:
        self.close()


class WholeChunkFile:
    """A new file; `flush` writes all pending bytes or none."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("xb", buffering=0)
        self._size = 0
        self._waiting = bytearray()

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self._size + len(self._waiting)

    def flush(self) -> None:
        rest = memoryview(bytes(self._waiting))
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            with suppress(OSError):
                self._file.truncate(self._size)
                self._file.seek(self._size)
            raise
        self._size += len(self._waiting)
        self._waiting.clear()

    def close(self) -> None:
        self._file.close()

    @property
    def closed(self) -> bool:
        return self._file.closed


def _program() -> str:
    try:
        return f"ratslam {version('ratslam')}"
    except PackageNotFoundError:  # in a checkout
        return "ratslam"


def record_source(source: Source, path: Path) -> int:
    """Write all samples of a source to a new recording; returns their number."""
    with Recorder(path, source) as recorder:
        for sample in source:
            recorder.write(sample)
        return recorder.count


def recover(path: Path, out: Path) -> tuple[int, str]:
    """Copy every readable message of a truncated or damaged recording, unchanged, to a new, complete one.

    The new file appears under its name only when it is complete. Values are not checked.

    Returns:
        the number of samples, and the fault of the old file, '' if it was complete.

    Raises:
        InputError: `path` has no readable sample, or `out` exists.
    """
    require_file(path)
    require_new_file(out)
    scanner = McapScanner(path)
    entries = scanner.entries()
    first = next(entries, None)
    if first is None or scanner.description is None:
        raise scanner.unreadable_error()
    described = scanner.description

    def write(path: Path) -> None:
        with Recorder(path, described) as recorder:
            for entry in chain([first], entries):
                if entry.truth is not None:
                    recorder.append(TRUTH, entry.time, entry.truth)
                recorder.append(entry.name, entry.time, entry.message)
        if not scanner.count:
            raise scanner.unreadable_error()
        flush_to_disk(path)

    make_new_file(out, write)
    return scanner.count, scanner.broken
