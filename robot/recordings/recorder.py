"""Writes samples to a recording."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from robot.recordings.cdr import encode, encode_truth
from robot.recordings.mcap_writer import McapWriter
from robot.recordings.schemas import TRUTH
from robot.sources.source import Sample
from robot.sources.source_info import SourceInfo
from tactile.base.errors import InputError


class Recorder:
    """Writes samples to a new file; a context manager.

    Args: see `McapWriter`.

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
        info = info or SourceInfo()
        self._writer = McapWriter(
            path, view_shape=view_shape, whiskers=whiskers, rate_hz=rate_hz, info=info, chunk_s=chunk_s
        )

    @property
    def count(self) -> int:
        """Number of samples so far."""
        return self._writer.count

    def write(self, sample: Sample) -> None:
        """Append a sample.

        Raises:
            InputError: a shape, dtype or time that the recording cannot hold (nothing is written then), or
                the disk is full.
        """
        if not np.isfinite(sample.time):
            raise InputError("time", f"{sample.time}", "a finite number of seconds")
        described = self._writer.description
        name, message = encode(sample, described.view_shape, described.whiskers)
        if sample.truth is not None:  # written first, so that no truncated file has a reading without it
            self._writer.append(TRUTH, sample.time, encode_truth(sample.time, sample.truth))
        self._writer.append(name, sample.time, message)

    def close(self) -> None:
        """Finish the file; may be called again."""
        self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
