"""Writing a recording so that it stays readable when the power fails.

An MCAP file: zstd-compressed chunks with checksums, each handed to the operating system as soon as it is
full or half a second old, so that a killed process loses at most that half second.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from mcap.writer import CompressionType, Writer

from robot.messages import SCHEMAS, TRUTH, encode, encode_truth
from robot.source import Sample
from robot.walk import METADATA, TOPICS, Description
from tactile.errors import InputError


class Recorder:
    """Writes samples to a new file; a context manager.

    Args:
        path: must not exist yet.
        view_shape, whiskers: of every sample. rate_hz: how fast they come, if known; for readers' eyes only.
        rig: by what the samples were made (see `robot.source.Rigged`): what JSON can hold. It stands at the
            start of the file, so one that is cut off still has it.
        chunk_bytes: a chunk is written when it is so large, before compression,
        chunk_s: or when its last sample comes so many seconds after that of the chunk before.

    Raises:
        InputError: the file exists or cannot be made.
        ValueError, TypeError: the rig is more than JSON can hold.
    """

    def __init__(
        self,
        path: Path,
        *,
        view_shape: tuple[int, int, int] = (3, 6, 1),
        whiskers: int = 0,
        rate_hz: float = 0.0,
        rig: Mapping[str, Any] | None = None,
        chunk_bytes: int = 1 << 16,
        chunk_s: float = 0.5,
    ) -> None:
        description = Description(view_shape, whiskers, rate_hz, _program(), dict(rig or {}))
        metadata = description.to_metadata()
        Description.from_metadata(metadata)
        try:
            self._file = path.open("xb")
        except FileExistsError as error:
            raise InputError(
                str(path), "exists already", "a new file", "choose another name or move it"
            ) from error
        except OSError as error:
            raise InputError(str(path), f"cannot be written ({error.strerror})") from error
        self._description = description
        self._chunk_bytes, self._chunk_s = chunk_bytes, chunk_s
        self._pending, self._flushed = 0, -np.inf  # bytes in the open chunk; time of the last closed one
        self._channels: dict[str, int] = {}
        self.count = 0
        # Chunks are ended here, never by the library, so that each one reaches the operating system whole.
        self._writer = Writer(
            self._file, chunk_size=1 << 62, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        self._writer.start(library=_program())
        self._writer.add_metadata(METADATA, metadata)
        self._writer.flush()

    def write(self, sample: Sample) -> None:
        """Append a sample.

        Raises:
            InputError: a shape, dtype or time that the recording cannot hold; nothing is written then.
        """
        if not np.isfinite(sample.time):
            raise InputError("time", f"{sample.time}", "a finite number of seconds")
        shape, whiskers = self._description.view_shape, self._description.whiskers
        messages = [encode(sample, shape, whiskers)]
        if sample.truth is not None:  # first, so that a reading that survives has its truth
            messages.insert(0, (TRUTH, encode_truth(sample.time, sample.truth)))
        stamp = min(max(round(sample.time * 1e9), 0), (1 << 63) - 1)  # MCAP's clock has no negative times
        for name, message in messages:
            self._writer.add_message(self._channel(name), stamp, message, stamp, self.count % (1 << 32))
            self._pending += len(message)
        self.count += 1
        if self._pending >= self._chunk_bytes or abs(sample.time - self._flushed) >= self._chunk_s:
            self.flush()
            self._flushed = sample.time

    def flush(self) -> None:
        """Hand everything so far to the operating system."""
        self._writer.flush()
        self._pending = 0

    def close(self) -> None:
        """Finish the file; closing twice is fine."""
        if not self._file.closed:
            with self._file:
                self._writer.finish()

    def _channel(self, name: str) -> int:
        if name not in self._channels:
            schema = self._writer.register_schema(name, "ros2msg", SCHEMAS[name].encode())
            self._channels[name] = self._writer.register_channel(TOPICS[name], "cdr", schema)
        return self._channels[name]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _program() -> str:
    try:
        return f"ratslam {version('ratslam')}"
    except PackageNotFoundError:  # used from a checkout
        return "ratslam"
