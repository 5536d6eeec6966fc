"""Writes recordings as MCAP files that stay readable when the process is killed or the disk is full.

Chunks are zstd-compressed, have checksums, and reach the operating system as a whole.
"""

from __future__ import annotations

from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

import numpy as np
from mcap.writer import CompressionType, Writer

from robot.drivers.head.decoder import Cut, Frames
from robot.recordings.cdr import READINGS, SCHEMAS, TOPICS, TRUTH, Event, encode, encode_truth
from robot.recordings.mcap_scanner import METADATA, metadata_of, read_metadata
from robot.sources.source import Sample, SourceDescription, SourceInfo
from tactile.base.errors import InputError
from tactile.base.files import require_new_file

_CHUNK_BYTES = 1 << 16
"""Size of a chunk before compression."""


class RecordingWriteError(InputError):
    """The operating system refuses to write to a recording."""

    def __init__(self, path: Path, error: OSError) -> None:
        cure = "free space on the disk; the file is readable up to here"
        super().__init__(str(path), f"cannot be written any further ({error.strerror or error})", "", cure)


class Recorder:
    """Writes a new file; a context manager.

    Args:
        path: must not exist yet.
        view_shape, whiskers: of every sample. rate_hz: nominal rate, 0 if unknown; for information.
        info: devices, world and origin; stored at the start of the file, so that a truncated one has it.
        chunk_s: a chunk is written when it has `_CHUNK_BYTES`, or when the time of its last message differs
            from that of the previous chunk by this many seconds.

    Attributes:
        count: readings written so far.

    Raises:
        InputError: the file exists or cannot be created.
        ValueError, TypeError: provenance in `info` is not JSON.
    """

    def __init__(
        self,
        path: Path,
        *,
        view_shape: tuple[int, int, int] = (3, 6, 1),
        whiskers: int = 0,
        rate_hz: float = 0.0,
        info: SourceInfo | None = None,
        chunk_s: float = 0.5,
    ) -> None:
        described = SourceDescription(view_shape, whiskers, rate_hz, info or SourceInfo(), _program())
        metadata = metadata_of(described)
        read_metadata(metadata)
        self.path, self._sizes = path, (view_shape, whiskers)
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
        """Append an encoded message with that schema; the truth of a reading precedes it.

        Raises:
            RecordingWriteError: the operating system refuses to write.
        """
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

    def flush(self) -> None:
        """Hand all messages so far to the operating system.

        Raises:
            RecordingWriteError: the operating system refuses to write.
        """
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

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
