"""Reading of .npz files, with errors that name the file."""

from __future__ import annotations

import io
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Sequence
from math import prod
from pathlib import Path
from typing import TypeVar

import numpy as np

from tactile.base import bounded
from tactile.base.bounded import check_size, malformed

T = TypeVar("T")

SPOILT = (*bounded.SPOILT, OSError, tokenize.TokenError, struct.error, zipfile.BadZipFile, zlib.error)
"""Errors of zipfile and NumPy in a spoilt file."""


def read_npz(
    path: str | Path, names: Sequence[str], parse: Callable[..., T], expected: str, cure: str = ""
) -> T:
    """The result of `parse`, called with the named arrays of a file.

    Args:
        parse: raises ValueError for unsuitable arrays. expected: kind of file. cure: for errors.

    Raises:
        InputError: the file is missing, malformed or lacks an array, or `parse` failed.
    """
    found = "another kind of file ({})"
    with malformed(path, expected, cure, found, SPOILT), zipfile.ZipFile(path) as archive:
        return parse(*read_arrays(archive, [f"{name}.npy" for name in names], str(path)))


def read_arrays(archive: zipfile.ZipFile, members: Sequence[str], where: str) -> list[np.ndarray]:
    """Arrays of an archive, whose size is checked before they are read and whose checksum before they are
    parsed; objects are refused.

    Raises:
        InputError: they are too large. One of `SPOILT`: one is missing, damaged, or no plain array.
    """
    infos = [archive.getinfo(member) for member in members]
    check_size(where, sum(info.file_size for info in infos), archive.start_dir)
    return [_array(archive, info) for info in infos]


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    content = io.BytesIO(archive.read(info))
    version = np.lib.format.read_magic(content)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(content)
    # Compared as Python's integers, because NumPy's may overflow.
    left = info.file_size - content.tell()
    if not dtype.hasobject and (min(shape, default=0) < 0 or prod(shape) * dtype.itemsize != left):
        raise ValueError(f"{info.filename} is not a plain array")
    content.seek(0)
    return np.lib.format.read_array(content, allow_pickle=False)
