"""Map files: the one place that reads them.

A map file (NumPy's .npz; `map.npz` of a run directory) holds the arrays of a session, the completed
configuration, the description of the readings, and a sha256 over all of it.
"""

from __future__ import annotations

import hashlib
import stat
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import numpy as np

from ratslam.core.arrays import fill_missing, with_prefix
from ratslam.core.backend import Map
from ratslam.methods.config import LocaliseConfig
from tactile.base.bounded import NPZ_SPOILT, malformed, read_arrays
from tactile.base.errors import InputError

FORMAT = "ratslam-map-3"
"""Name and version of the format; a later version reads it."""
FORMATS = ("ratslam-map-1", "ratslam-map-2", FORMAT)
"""The formats that are read. The first does not tell `Session.earlier`; the first two have no belief of pose
cells."""
EXPECTED = "a map: a run directory, its map.npz, or a file written by Slam.save"
ARCHIVE = b"PK"
"""Beginning of every map file, which distinguishes a damaged one from another file."""


def _read_all(file: Path) -> dict[str, np.ndarray]:
    """All arrays of a file that is a map by the names in it and by its size.

    Raises:
        InputError: it is no such file, damaged, of an unknown format, or cannot be read.
    """
    with malformed(file, EXPECTED, "check the path and its permissions"):
        if not stat.S_ISREG(file.stat().st_mode):
            raise InputError(str(file), "neither a file nor a folder", EXPECTED)
        with file.open("rb") as opened:
            begin = opened.read(len(ARCHIVE))
    found = "damaged, or not a map ({})" if begin == ARCHIVE else "not a map"
    found, cure = found if begin else "empty, so not a map", "restore it from a copy if it was one"
    with malformed(file, EXPECTED, cure, found, NPZ_SPOILT), zipfile.ZipFile(file) as archive:
        members = [name.removesuffix(".npy") for name in archive.namelist()]
        if "steps" not in members:
            raise InputError(str(file), "an archive of other arrays", EXPECTED)
        if "format" in members:
            (array,) = read_arrays(archive, ["format.npy"], str(file))
            if array.shape or array.dtype.kind != "U" or str(array) not in FORMATS:
                found = repr(str(array)[:40]) if not array.shape else "numbers"
                cure = "update ratslam if a newer version wrote it"
                raise InputError(str(file), f"the map format {found}", " or ".join(FORMATS), cure)
        arrays = read_arrays(archive, archive.namelist(), str(file))
        return dict(zip(members, arrays, strict=True))


def digest_of(arrays: Mapping[str, np.ndarray]) -> str:
    """The sha256 (hex) over names, dtypes, shapes and bytes of all arrays, sorted by name, but `sha256`."""
    digest = hashlib.sha256()
    for name in sorted(set(arrays) - {"sha256"}):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}\0{array.dtype.str}\0{arrays[name].shape}\0".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


NAME = "map.npz"
"""The map file of a run directory."""
TEXTS = ("format", "config", "source", "recording", "sha256")
"""Texts in a map file beside the arrays of the session: format, completed configuration (YAML), description
of the readings (JSON), sha256 of the recording ('' without), and sha256 of all the others (`digest_of`)."""


def map_file(path: Path) -> Path:
    """The map file of a run directory, or the file itself."""
    return path / NAME if path.is_dir() else path


def read_map_arrays(file: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """The arrays of a map file, and its texts.

    Raises:
        InputError: there is none; it is broken, incomplete, or of an unknown format.
    """
    arrays, texts = _read_all(file), {}
    for name in TEXTS:
        found = arrays.get(name)
        if found is None or found.shape or found.dtype.kind != "U":
            problem = f"a file without {name!r}" if found is None else f"{name!r} is not a text"
            raise InputError(str(file), problem, EXPECTED)
        texts[name] = str(found)
    if digest_of(arrays) != texts["sha256"]:
        problem = "damaged: the content does not match its sha256"
        raise InputError(str(file), problem, "the file as it was written", "restore it from a copy")
    return {name: values for name, values in arrays.items() if name not in TEXTS}, texts


FinishedMap = TypeVar("FinishedMap", bound=Map)


def restore_map(config: LocaliseConfig, made: FinishedMap, method: str) -> FinishedMap:
    """The map that a configuration names, by its file or its run directory.

    Args:
        made: a new map of a backend with the settings of the file. method: its value of `backend`.

    Raises:
        InputError: the configuration names none, or the file cannot be read, was made with other settings, or
            holds a map without a step.
    """
    if config.map is None:
        raise InputError("localise.map", "missing", "the file of a map, such as map.npz of a run")
    path = map_file(config.map)
    if not path.is_file():
        found = "neither a file nor a folder" if path.exists() else "no such file"
        cure = "put it back, or set localise.map to where it is"
        raise InputError(str(path), found, "the map in which the session is localised", cure)
    arrays, _ = read_map_arrays(path)
    expected = f"a map made by `backend: {method}` with the same settings"
    with malformed(path, expected, found="{}", spoilt=NPZ_SPOILT):
        fill_missing(arrays)
        made.restore(with_prefix(arrays, "map/"))
    if not len(made.trajectory()):
        raise InputError(str(path), "a map without steps", "a map in which a session can be found")
    return made
