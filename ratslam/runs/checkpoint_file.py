"""The arrays of a map file, a NumPy archive (.npz) whose damage is told from other files."""

from __future__ import annotations

import hashlib
import stat
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tactile.base import npz
from tactile.base.atomic_write import flush_to_disk
from tactile.base.bounded import malformed
from tactile.base.errors import InputError
from tactile.base.npz import SPOILT

FORMAT = "ratslam-map-3"
"""Name and version of the format; a later version reads it."""
FORMATS = ("ratslam-map-1", "ratslam-map-2", FORMAT)
"""The formats that are read. The first does not tell `Session.earlier`; the first two have no belief of pose
cells."""
EXPECTED = "a map: a run directory, its map.npz, or a file written by Slam.save"
ARCHIVE = b"PK"
"""Beginning of every map file, by which a damaged one is told from another file."""


def read_arrays(file: Path) -> dict[str, np.ndarray]:
    """All arrays of a file that is a map by the names in it and by its size.

    Raises:
        InputError: it is no such file, damaged, of an unknown format, or cannot be read.
    """
    begin = _begin(file)
    found = "damaged, or not a map ({})" if begin == ARCHIVE else "not a map"
    found, cure = found if begin else "empty, so not a map", "restore it from a copy if it was one"
    with malformed(file, EXPECTED, cure, found, SPOILT), zipfile.ZipFile(file) as archive:
        members = [name.removesuffix(".npy") for name in archive.namelist()]
        if "steps" not in members:
            raise InputError(str(file), "an archive of other arrays", EXPECTED)
        if "format" in members:
            _check_format(file, *npz.read_arrays(archive, ["format.npy"], str(file)))
        arrays = npz.read_arrays(archive, archive.namelist(), str(file))
        return dict(zip(members, arrays, strict=True))


def _begin(file: Path) -> bytes:
    """The first bytes of a file.

    Raises:
        InputError: there is none, it is not a plain file, or it cannot be read.
    """
    with malformed(file, EXPECTED, "check the path and its permissions"):
        if not stat.S_ISREG(file.stat().st_mode):
            raise InputError(str(file), "neither a file nor a folder", EXPECTED)
        with file.open("rb") as opened:
            return opened.read(len(ARCHIVE))


def _check_format(file: Path, array: np.ndarray) -> None:
    if array.shape or array.dtype.kind != "U" or str(array) not in FORMATS:
        found = repr(str(array)[:40]) if not array.shape else "numbers"
        cure = "update ratslam if a newer version wrote it"
        raise InputError(str(file), f"the map format {found}", " or ".join(FORMATS), cure)


def text_of(file: Path, arrays: Mapping[str, np.ndarray], name: str) -> str:
    """A text among the arrays of a file.

    Raises:
        InputError: there is no such text.
    """
    found = arrays.get(name)
    if found is None or found.shape or found.dtype.kind != "U":
        problem = f"a file without {name!r}" if found is None else f"{name!r} is not a text"
        raise InputError(str(file), problem, EXPECTED)
    return str(found)


def digest_of(arrays: Mapping[str, np.ndarray]) -> str:
    """The sha256 (hex) over names, dtypes, shapes and bytes of all arrays, sorted by name, but `sha256`."""
    digest = hashlib.sha256()
    for name in sorted(set(arrays) - {"sha256"}):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}\0{array.dtype.str}\0{arrays[name].shape}\0".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def write_arrays(path: Path, arrays: dict[str, Any], compressed: bool = True) -> None:
    """Writes the arrays to a file that may be moved to its place afterwards."""
    with path.open("wb") as file:  # with a path, NumPy would add a suffix
        (np.savez_compressed if compressed else np.savez)(file, **arrays)
    flush_to_disk(path)
