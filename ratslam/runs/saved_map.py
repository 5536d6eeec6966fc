"""Saved maps: a session with its configuration and the description of its readings, in a map file
(`ratslam.methods.map_file`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ratslam.core.arrays import fill_missing, with_prefix
from ratslam.core.session import UNKNOWN, Session
from ratslam.methods.map_file import EXPECTED, FORMAT, FORMATS, digest_of, map_file, read_map_arrays
from ratslam.methods.method_registry import BACKENDS, LOCALISING
from ratslam.runs.build_session import build_session
from ratslam.runs.estimate import START, PoseEstimate
from ratslam.runs.map_settings import Sensor, check_same_settings
from ratslam.runs.settings.run_config import LoopConfig, RunConfig
from ratslam.runs.settings.strict_yaml import MAP, dump, kind_of, parse, validate, with_moved_settings
from robot.sources.source import Source, SourceDescription, describe
from robot.touch_source import TouchSource
from tactile.base.bounded import NPZ_SPOILT, malformed, reason
from tactile.base.errors import InputError
from tactile.base.files import flush_to_disk, unfinished_change, write_atomically

ESTIMATE, FRONTEND, STATE = "estimate/", "frontend/", "state/"
CHANGED = ("recall", "localise")
"""Methods whose maps of earlier versions have another state: one without the belief of the pose cells."""


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

    def samples_of(self, recording: str) -> int | None:
        """Number of samples of a recording, by its sha256, that are in the map; None if it is not the one
        mapped last, or has no sha256.

        Raises:
            InputError: the file is of an earlier version that does not tell.
        """
        if not recording or recording != self.recording:
            return None
        earlier = int(self.arrays["earlier"])
        if earlier == UNKNOWN:
            found = f"{self.steps} steps of several recordings, and not how many are of the last one"
            cure = "continue the map that this one went on from, or map the recording anew"
            raise InputError(str(self.path), found, f"a file of the format {FORMAT}", cure)
        return self.steps - earlier

    @property
    def sensor(self) -> Sensor:
        """The sensor that the map was made with."""
        return Sensor.of(self.config, self.source)

    def open_session(self) -> Session:
        """A session that goes on from this map, with the map in it.

        Raises:
            InputError: the arrays do not fit the configuration.
        """
        session = build_session(self.config, self.source)
        self.restore(session, self.config)
        return session

    def restore(self, session: Session, config: RunConfig) -> None:
        """Replaces the state and the map of a session by those saved.

        Args:
            config: of the session, completed; of the map's method.

        Raises:
            InputError: the session has other settings that the arrays do not fit, which are named, or another
                view shape; or the arrays are incomplete.
        """
        cure = "continue with the configuration and the sensor of the map"
        try:
            session.restore(dict(self.arrays))
            found = _mismatch(self.arrays, session.arrays())
        except NPZ_SPOILT as error:
            found = reason(error)
        if found:
            check_same_settings(str(self.path), self.config, config)
            expected = "a map made with this configuration"
            if self.config.backend in LOCALISING.values():
                place = self.config.localise.map
                expected = f"{place} as it was when this session was localised in it"
                cure = "restore that map from a copy, or localise the recording again"
            raise InputError(str(self.path), found, expected, cure) from None


def is_map(path: Path) -> bool:
    """Whether a path is a map by the names in its file."""
    return kind_of(map_file(path)) == MAP


def read_map(path: Path, report: Callable[[str], None] | None = None) -> SavedMap:
    """The map in a run directory or a map file.

    Args:
        report: called with one sentence if a change of its folder was cut off.

    Raises:
        InputError: there is none; it is broken, incomplete, of an unknown format, or made by a backend that
            is not registered.
    """
    file = map_file(path)
    undone = unfinished_change(file.parent)
    if undone is not None and report is not None:
        cure = f"repeat `ratslam map undo {file.parent} {undone}` to complete it"
        report(f"{file.parent}: the undo of sequence {undone} was cut off; {cure}")
    arrays, texts = read_map_arrays(file)
    config = validate(with_moved_settings(parse(texts["config"], f"{file}: config")), LoopConfig)
    BACKENDS.get(config.backend, f"{file}: backend")
    if texts["format"] == FORMATS[0]:
        # Unknown if a recording after the first began a piece of the map.
        names = ("map/graph/begins", "map/archive/graph/begins", "map/begins/0")
        begun = any(np.any(arrays[name]) for name in names if name in arrays)
        arrays["earlier"] = np.array(UNKNOWN if begun else 0)
    with malformed(file, EXPECTED, found="{}", spoilt=NPZ_SPOILT):
        source = SourceDescription.from_json(texts["source"])
        estimate = PoseEstimate.of_arrays(with_prefix(arrays, ESTIMATE))
        steps, earlier = (int(arrays[name]) for name in ("steps", "earlier"))
    if steps < 0:
        raise InputError(str(file), f"{steps} steps", EXPECTED)
    if not UNKNOWN <= earlier <= steps:
        raise InputError(str(file), f"{earlier} steps of earlier recordings among {steps}", EXPECTED)
    session = {n: values for n, values in arrays.items() if not n.startswith((ESTIMATE, FRONTEND))}
    fill_missing(session)
    if texts["format"] != FORMAT:
        session["sides"] = np.zeros(0, np.int64)
        if config.backend in CHANGED:
            session = {name: value for name, value in session.items() if not name.startswith(STATE)}
    return SavedMap(
        file, texts["format"], texts["sha256"], config, source, texts["recording"], session, estimate,
        with_prefix(arrays, FRONTEND),
    )  # fmt: skip


def write_map(
    path: Path,
    session: Session,
    config: RunConfig,
    source: SourceDescription,
    *,
    recording: str = "",
    estimate: PoseEstimate = START,
    frontend: Mapping[str, np.ndarray] | None = None,
    compressed: bool = True,
) -> None:
    """Writes a map file atomically: a reader, also after a kill or a power failure, finds the file that was
    there or the new one.

    Args, in addition to `SavedMap`:
        source: as `describe_readings` gives it. compressed: False takes a tenth of the time and thrice the
            space.
    """
    arrays: dict[str, Any] = session.arrays() | {
        "format": np.array(FORMAT),
        "config": np.array(dump(config.model_copy(update={"cells": None}))),  # of a run, not of its map
        "source": np.array(source.to_json()),
        "recording": np.array(recording),
    }
    arrays |= {ESTIMATE + name: value for name, value in estimate.arrays().items()}
    arrays |= {FRONTEND + name: np.asarray(value) for name, value in (frontend or {}).items()}
    arrays["sha256"] = np.array(digest_of(arrays))

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:  # with a path, NumPy would add a suffix
            (np.savez_compressed if compressed else np.savez)(file, **arrays)
        flush_to_disk(temporary)

    write_atomically(path, write)


def describe_readings(source: Source) -> SourceDescription:
    """The description of the readings of a source of observations: its view shape, and the information of the
    source whose readings the observations were made of."""
    readings = source
    while isinstance(readings, TouchSource):
        readings = readings.source
    return replace(describe(source), info=readings.info)


def _mismatch(saved: Mapping[str, np.ndarray], restored: Mapping[str, np.ndarray]) -> str:
    """How saved arrays differ from those of the session restored from them, or ''; a state that was not saved
    does not count."""
    if not any(name.startswith(STATE) for name in saved):
        restored = {name: value for name, value in restored.items() if not name.startswith(STATE)}
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
