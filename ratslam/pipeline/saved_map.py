"""Map files: the one place that reads and writes them.

A map file (NumPy's .npz; `map.npz` of a run directory) holds the arrays of a session, the completed
configuration, the description of the readings, and a sha256 over all of it.
"""

from __future__ import annotations

import hashlib
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ratslam.backends.registry import BACKENDS, LOCALISING
from ratslam.config.run_config import LoopConfig, RunConfig, load_config
from ratslam.config.strict_yaml import dump, parse, validate
from ratslam.core.checkpoint import with_prefix
from ratslam.core.session import Session
from ratslam.pipeline.build_session import build_session
from ratslam.pipeline.estimate import START, PoseEstimate, estimate_arrays, read_estimate
from ratslam.pipeline.folder_change import unfinished_change
from ratslam.pipeline.sensor import Sensor, sensor_of
from ratslam.pipeline.source import open_observations
from robot.sources.description import SourceDescription, describe
from robot.sources.source import Source
from robot.touch_source import TouchSource, open_touch_source
from tactile.base.atomic_write import flush_to_disk, write_atomically
from tactile.base.errors import InputError

FORMAT = "ratslam-map-1"
"""Name and version of the format; a later version reads it."""
NAME = "map.npz"
"""The map file of a run directory."""
EXPECTED = "a map: a run directory, its map.npz, or a file written by Slam.save"
TEXTS = ("format", "config", "source", "recording", "sha256")
"""Texts in a map file beside the arrays of the session: format, completed configuration (YAML), description
of the readings (JSON), sha256 of the recording ('' without), and sha256 of all the others (`digest_of`)."""
ESTIMATE, FRONTEND = "estimate/", "frontend/"
ARCHIVE = b"PK"
"""Beginning of every map file, by which a damaged one is told from another file."""
MOST_BYTES = 8 << 30
"""Largest size of all arrays of a map file."""
SPOILT = (
    OSError, ValueError, LookupError, EOFError, TypeError, AttributeError, SyntaxError, RuntimeError,
    MemoryError, OverflowError, tokenize.TokenError, struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Errors of zipfile and NumPy in a spoilt file, and of a session in arrays that do not fit it."""


@dataclass(frozen=True, eq=False)
class SavedMap:
    """A map as it was saved.

    Attributes:
        path: of the file. format: its name and version. digest: sha256 (hex) of its content.
        config: completed for the source. source: description of the readings; its view shape is that of the
            observations. recording: sha256 (hex) of the recording that was mapped last, '' if there is none.
        arrays: of the session. estimate: of the last step. frontend: what the touch front end remembers of
            earlier readings; empty if it was not saved.
    """

    path: Path
    format: str
    digest: str
    config: RunConfig
    source: SourceDescription
    recording: str
    arrays: Mapping[str, np.ndarray]
    estimate: PoseEstimate = START
    frontend: Mapping[str, np.ndarray] | None = None

    @property
    def steps(self) -> int:
        """Number of observations in the map."""
        return int(self.arrays["steps"])

    @property
    def sensor(self) -> Sensor:
        """The sensor that the map was made with."""
        return sensor_of(self.config, self.source)

    def open_session(self) -> Session:
        """A session that goes on from this map, with the map in it.

        Raises:
            InputError: the arrays do not fit the configuration.
        """
        session = build_session(self.config, self.source)
        self.restore(session)
        return session

    def restore(self, session: Session) -> None:
        """Replaces the state and the map of a session by those saved.

        Raises:
            InputError: the session has another configuration or view shape, or the arrays are incomplete.
        """
        cure = "continue with the configuration and the sensor of the map"
        try:
            session.restore(dict(self.arrays))
            found = _mismatch(self.arrays, session.arrays())
        except SPOILT as error:
            found = f"without {error}" if isinstance(error, KeyError) else str(error) or type(error).__name__
        if found:
            expected = "a map made with this configuration"
            if self.config.backend in LOCALISING.values():
                place = self.config.localise.map
                expected = f"{place} as it was when this session was localised in it"
                cure = "restore that map from a copy, or localise the recording again"
            raise InputError(str(self.path), found, expected, cure) from None


def map_file(path: Path) -> Path:
    """The map file of a run directory, or the file itself."""
    return path / NAME if path.is_dir() else path


def is_map(path: Path) -> bool:
    """Whether a path is a map by the names in its file."""
    file = map_file(path)
    try:
        if not file.is_file():
            return False
        with zipfile.ZipFile(file) as archive:
            return {"steps.npy", "config.npy"} <= set(archive.namelist())
    except (OSError, zipfile.BadZipFile):
        return False


def read_map(path: Path, report: Callable[[str], None] | None = None) -> SavedMap:
    """The map in a run directory or a map file.

    Args:
        report: called with one sentence if the file is of an earlier format and was converted, or if a change
            of its folder was cut off.

    Raises:
        InputError: there is none; it is broken, incomplete, of an unknown format, or made by a backend that
            is not registered.
    """
    file = map_file(path)
    undone = unfinished_change(file.parent)
    if undone is not None and report is not None:
        cure = f"repeat `ratslam map undo {file.parent} {undone}` to complete it"
        report(f"{file.parent}: the undo of sequence {undone} was cut off; {cure}")
    arrays = _read_arrays(file)
    if "format" not in arrays:
        return _convert(file, arrays, report)
    texts = {name: _text(file, arrays, name) for name in TEXTS}
    if digest_of(arrays) != texts["sha256"]:
        found = "damaged: the content does not match its sha256"
        raise InputError(str(file), found, "the file as it was written", "restore it from a copy")
    return _saved_map(file, arrays, texts)


def write_map(
    path: Path,
    session: Session,
    config: RunConfig,
    source: SourceDescription,
    *,
    recording: str = "",
    estimate: PoseEstimate = START,
    frontend: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Writes a map file atomically: a reader, also after a kill or a power failure, finds the file that was
    there or the new one.

    Args, in addition to `SavedMap`:
        source: as `describe_readings` gives it.
    """
    arrays: dict[str, Any] = session.arrays() | {
        "format": np.array(FORMAT),
        "config": np.array(dump(config.model_copy(update={"cells": None}))),  # of a run, not of its map
        "source": np.array(source.to_json()),
        "recording": np.array(recording),
    }
    arrays |= {ESTIMATE + name: value for name, value in estimate_arrays(estimate).items()}
    arrays |= {FRONTEND + name: np.asarray(value) for name, value in (frontend or {}).items()}
    arrays["sha256"] = np.array(digest_of(arrays))
    write_atomically(path, lambda temporary: _write_arrays(temporary, arrays))


def describe_readings(source: Source) -> SourceDescription:
    """The description of the readings of a source of observations: its view shape, and the information of the
    source whose readings the observations were made of."""
    readings = source
    while isinstance(readings, TouchSource):
        readings = readings.source
    return SourceDescription(
        source.view_shape, source.whiskers, source.rate_hz, describe(readings).info, source.name
    )


def digest_of(arrays: Mapping[str, np.ndarray]) -> str:
    """The sha256 (hex) over names, dtypes, shapes and bytes of all arrays, sorted by name, but `sha256`."""
    digest = hashlib.sha256()
    for name in sorted(set(arrays) - {"sha256"}):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name}\0{array.dtype.str}\0{arrays[name].shape}\0".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _saved_map(file: Path, arrays: dict[str, np.ndarray], texts: Mapping[str, str]) -> SavedMap:
    config = validate(parse(texts["config"], f"{file}: config"), LoopConfig)
    BACKENDS.get(config.backend, f"{file}: backend")
    try:
        source = SourceDescription.from_json(texts["source"])
        estimate = read_estimate(with_prefix(arrays, ESTIMATE))
        steps = int(arrays["steps"])
    except SPOILT as error:
        missing = f"without {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(str(file), missing, EXPECTED) from None
    if steps < 0:
        raise InputError(str(file), f"{steps} steps", EXPECTED)
    own = {name: value for name, value in arrays.items() if name not in TEXTS}
    session = {name: value for name, value in own.items() if not name.startswith((ESTIMATE, FRONTEND))}
    return SavedMap(
        file, texts["format"], texts["sha256"], config, source, texts["recording"], session, estimate,
        with_prefix(arrays, FRONTEND),
    )  # fmt: skip


def _convert(file: Path, arrays: dict[str, np.ndarray], report: Callable[[str], None] | None) -> SavedMap:
    """The map in a file written before there was a format: by `Slam.save`, which kept its configuration, or
    in a run directory, where it stands beside it."""
    if "source" in arrays:
        config: RunConfig = validate(parse(_text(file, arrays, "config"), f"{file}: config"), LoopConfig)
        try:
            readings = SourceDescription.from_json(_text(file, arrays, "source"))
        except ValueError as error:
            raise InputError(str(file), str(error), EXPECTED) from None
        source = describe_readings(open_touch_source(readings, config.touch))
    else:
        beside = file.with_name("config.yaml")
        if not beside.is_file():
            found = "a map file of an earlier version, which does not say how it was made"
            cure = "put the config.yaml of its run beside it, or map the recording again"
            raise InputError(str(file), found, f"a file of the format {FORMAT}", cure)
        with open_observations(load_config(beside)) as (config, observed):
            source = describe_readings(observed)
    recording = str(arrays.pop("digest", ""))
    texts = {"format": FORMAT, "config": dump(config), "source": source.to_json(), "recording": recording}
    arrays |= {name: np.array(value) for name, value in texts.items()}
    digest = digest_of(arrays)
    if report is not None:
        report(f"{file}: of an earlier version; read as {FORMAT}")
    return _saved_map(file, arrays, texts | {"sha256": digest})


def _mismatch(saved: Mapping[str, np.ndarray], restored: Mapping[str, np.ndarray]) -> str:
    """How saved arrays differ from those of the session restored from them, or ''."""
    for name in sorted(set(saved) | set(restored)):
        if name not in restored:
            return f"the unknown array {name}"
        if name not in saved:
            return f"without {name}"
        for what in ("shape", "dtype"):
            found, expected = getattr(saved[name], what), getattr(restored[name], what)
            if found != expected:
                return f"the array {name} of {what} {found} instead of {expected}"
    return ""


def _read_arrays(file: Path) -> dict[str, np.ndarray]:
    """All arrays of a file that is a map by the names in it and by its size."""
    begin = _begin(file)
    try:
        with zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            if "steps" not in members:
                raise InputError(str(file), "an archive of other arrays", EXPECTED)
            if "format" in members:
                _check_format(file, _array(archive, members["format"]))
            size = sum(info.file_size for info in members.values())
            if size > MOST_BYTES:
                found = f"arrays of {size / 2**30:.1f} GiB"
                raise InputError(str(file), found, f"a map of at most {MOST_BYTES >> 30} GiB")
            return {name: _array(archive, info) for name, info in members.items()}
    except InputError:
        raise
    except SPOILT as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        spoilt = f"damaged, or not a map ({reason})" if begin == ARCHIVE else "not a map"
        found = spoilt if begin else "empty, so not a map"
        raise InputError(str(file), found, EXPECTED, "restore it from a copy if it was one") from None


def _begin(file: Path) -> bytes:
    """The first bytes of a file.

    Raises:
        InputError: there is none, it is not a plain file, or it cannot be read.
    """
    try:
        if not stat.S_ISREG(file.stat().st_mode):
            raise InputError(str(file), "neither a file nor a folder", EXPECTED)
        with file.open("rb") as opened:
            return opened.read(len(ARCHIVE))
    except FileNotFoundError:
        raise InputError(str(file), "no such file", EXPECTED) from None
    except OSError as error:
        found = f"cannot be read ({error.strerror})"
        raise InputError(str(file), found, EXPECTED, "check the path and its permissions") from None


def _array(archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> np.ndarray:
    content = BytesIO(archive.read(info))  # whole, so that its checksum is compared before it is parsed
    array = np.lib.format.read_array(content, allow_pickle=False)
    if array.dtype.hasobject or content.read(1):
        raise ValueError(f"{info.filename} is not a plain array")
    return array


def _check_format(file: Path, array: np.ndarray) -> None:
    if array.shape or array.dtype.kind != "U" or str(array) != FORMAT:
        found = repr(str(array)[:40]) if not array.shape else "numbers"
        cure = "update ratslam if a newer version wrote it"
        raise InputError(str(file), f"the map format {found}", FORMAT, cure)


def _text(file: Path, arrays: Mapping[str, np.ndarray], name: str) -> str:
    """A text among the arrays of a file."""
    found = arrays.get(name)
    if found is None or found.shape or found.dtype.kind != "U":
        problem = f"a file without {name!r}" if found is None else f"{name!r} is not a text"
        raise InputError(str(file), problem, EXPECTED)
    return str(found)


def _write_arrays(path: Path, arrays: dict[str, Any]) -> None:
    with path.open("wb") as file:  # with a path, NumPy would add a suffix
        np.savez_compressed(file, **arrays)
    flush_to_disk(path)
