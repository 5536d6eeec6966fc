"""Reads the finished map in which a session is localised."""

from __future__ import annotations

import zipfile
from typing import TypeVar

from ratslam.core.arrays import fill_missing, with_prefix
from ratslam.core.backend import Map
from ratslam.methods.config import LocaliseConfig
from tactile.base.bounded import NPZ_SPOILT, malformed, read_arrays
from tactile.base.errors import InputError

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
    path = config.map / "map.npz" if config.map.is_dir() else config.map
    if not path.is_file():
        found = "neither a file nor a folder" if path.exists() else "no such file"
        cure = "put it back, or set localise.map to where it is"
        raise InputError(str(path), found, "the map in which the session is localised", cure)
    expected = f"a map made by `backend: {method}` with the same settings"
    with malformed(path, expected, found="{}", spoilt=NPZ_SPOILT):
        with zipfile.ZipFile(path) as archive:
            names = [name for name in archive.namelist() if name.startswith("map/")]
            arrays = read_arrays(archive, names, str(path))
        known = dict(zip([name.removesuffix(".npy") for name in names], arrays, strict=True))
        fill_missing(known)
        made.restore(with_prefix(known, "map/"))
    if not len(made.trajectory()):
        raise InputError(str(path), "a map without steps", "a map in which a session can be found")
    return made
