"""Bounds on what compressed chunks, messages and files of bags expand to, for rosbags, which has none."""

from __future__ import annotations

import bz2
import io
from collections.abc import Callable
from types import SimpleNamespace
from typing import IO, Any, cast

import zstandard

from tactile.base.bounded import check_size, expand


def _zstd(file: IO[bytes]) -> IO[bytes]:
    return cast(IO[bytes], zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True))


def _lz4(file: IO[bytes]) -> IO[bytes]:
    import lz4.frame

    return cast(IO[bytes], lz4.frame.open(file))


def _expander(open_reader: Callable[[IO[bytes]], IO[bytes]], what: str) -> Callable[..., bytes]:
    """A function of compressed bytes (and a size that is said, not believed)."""
    return lambda content, *_: expand(open_reader(io.BytesIO(content)), what, len(content))


expand_message = _expander(_zstd, "a compressed message")
"""What a message expands to that is compressed with zstd; an `InputError` if it is too much."""


class _Counted(io.RawIOBase):
    """A decompressed file; an `InputError` where it becomes too large."""

    def __init__(self, file: IO[bytes]) -> None:
        self._stored, self._size = file.seek(0, 2), 0
        file.seek(0)
        self._reader = _zstd(file)

    def read(self, size: int = -1) -> bytes:
        piece = self._reader.read(size)
        self._size += len(piece)
        check_size("a compressed file", self._size, self._stored)
        return piece


def bound_expansion() -> None:
    """Replaces the decompressors of rosbags by bounded ones."""
    from rosbags.rosbag1 import reader as first
    from rosbags.rosbag2 import reader as second
    from rosbags.rosbag2 import storage_mcap

    chunk = "a compressed chunk"
    openers: dict[str, Callable[..., Any]] = {"bz2": bz2.BZ2File, "lz4": _lz4, "zstd": _zstd}
    functions = {name: _expander(reader, chunk) for name, reader in openers.items()}
    for known in (first.decompressors, storage_mcap.DECOMPRESSORS):
        known.update({name: function for name, function in functions.items() if name in known})
    zstd = SimpleNamespace(decompress=expand_message, open=lambda file, _: _Counted(file))
    second.zstd = cast(Any, zstd)
