"""Bounds on what compressed chunks, messages and files of bags expand to, for rosbags, which has none."""

from __future__ import annotations

import bz2
import io
from types import SimpleNamespace
from typing import IO, Any, cast

import zstandard

from tactile.base.bounded import check_size, expand


def _zstd(file: IO[bytes]) -> IO[bytes]:
    return cast(IO[bytes], zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True))


def expand_message(content: bytes) -> bytes:
    """What a message expands to that is compressed with zstd; an `InputError` if it is too much."""
    return expand(_zstd(io.BytesIO(content)), "a compressed message", len(content))


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
    import lz4.frame
    from rosbags.rosbag1 import reader as first
    from rosbags.rosbag2 import reader as second
    from rosbags.rosbag2 import storage_mcap

    openers: dict[str, Any] = {"bz2": bz2.BZ2File, "lz4": lz4.frame.open, "zstd": _zstd}
    for known in (first.decompressors, storage_mcap.DECOMPRESSORS):
        for name in known.keys() & openers.keys():  # a size that is said is not believed
            known[name] = lambda content, *_, opener=openers[name]: expand(
                opener(io.BytesIO(content)), "a compressed chunk", len(content)
            )
    zstd = SimpleNamespace(decompress=expand_message, open=lambda file, _: _Counted(file))
    second.zstd = cast(Any, zstd)
