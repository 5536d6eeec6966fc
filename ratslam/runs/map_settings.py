"""The settings and the sensor that a map depends on, and how those of another map or session differ.

The sensor of a map is what its views are measured with, and how they are made of the readings.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from ratslam.methods.method_registry import BACKENDS, LOCALISING
from ratslam.runs.settings.run_config import RunConfig
from robot.recordings.video import SUFFIXES as VIDEO_SUFFIXES
from robot.sources.source import Source
from tactile.base.errors import InputError


def check_same_method(where: str, of_map: RunConfig, other: RunConfig) -> None:
    """Raises `InputError` if a session with another method is to go on from a map.

    Args:
        where: the map, for the error.
    """
    if of_map.backend != other.backend:
        cure = f"`--set backend={of_map.backend}` takes that of the map"
        if of_map.backend in LOCALISING.values():
            cure = f"continue the map in which that session was localised, {of_map.localise.map}"
        raise _error(where, {"backend": [of_map.backend, other.backend]}, cure)


def check_same_settings(where: str, of_map: RunConfig, other: RunConfig) -> None:
    """The same with other settings of the method or another precision; all that differ are named. Both are
    completed.
    """
    different = differing_settings([of_map, other])
    if different:
        cure = assignments({name: both[0] for name, both in different.items()})
        raise _error(where, different, f"`{cure}` takes those of the map")


def assignments(settings: dict[str, Any]) -> str:
    """Settings as options of a command."""
    return " ".join(f"--set {shlex.quote(f'{name}={_text(value)}')}" for name, value in settings.items())


def differing_settings(configs: Sequence[RunConfig]) -> dict[str, list[Any]]:
    """The settings of the method and the precision that are not the same in all completed configurations, by
    their dotted names, with the value in each."""
    each = [_settings(config) for config in configs]
    names = dict.fromkeys(name for settings in each for name in settings)
    values = {name: [settings.get(name) for settings in each] for name in names}
    return {name: found for name, found in values.items() if any(value != found[0] for value in found)}


def _error(where: str, different: dict[str, list[Any]], cure: str) -> InputError:
    pairs = [f"{name} is {_text(ours)} and was {_text(was)}" for name, (was, ours) in different.items()]
    found = f"made with other settings: {', '.join(pairs)} when the map was made"
    return InputError(where, found, "a map made with this configuration", cure)


def _settings(config: RunConfig) -> dict[str, Any]:
    """What a method's state and map depend on, by dotted names as in a configuration; not whether keyframes
    are merged, which a session may begin or leave off at any time."""
    builtin = config.backend in BACKENDS.builtin
    kind = BACKENDS.get(config.backend, "backend").config_class
    names = list(kind.model_fields) if builtin else ["backend_settings"]
    plain = config.model_dump(mode="json", include={*names})
    precision = {"session.precision": config.session.precision}
    settings = flat_settings({name: plain[name] for name in names}) | precision
    return {name: value for name, value in settings.items() if name != "keyframes.merge_stood"}


def flat_settings(settings: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Settings as a configuration file nests them, each by its dotted name; an empty section is a value.

    Args:
        before: what the names begin with.
    """
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        section = isinstance(value, dict) and value
        flat |= flat_settings(value, f"{before}{name}.") if section else {before + name: value}
    return flat


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


WHISKER_HEAD, FIXED_WHISKERS, POKES = "whisker head", "fixed whiskers", "pokes of an arm"
OTHER_TOUCH = "registered touch sensor"
VIEWS, LABELS = "camera or laser", "given place labels"
UNITS = {True: "signed departures from rest, in the sensor's unit", False: "values in 0..1"}
Difference = tuple[str, Any, Any]
"""What differs, by the name of a setting or in words, and its values in a map and elsewhere."""
NORMALISATION = ("source", "normalise_mean", "patch", "patch_sd")

WORDS = {
    "kind": "the sensor",
    "view_shape": "the shape of the views",
    "whiskers": "the number of whiskers",
    "unit": "the unit of the views",
}
CELL = "pose_cells.cell_size"
SAME_FOV = 0.3  # rad, by which the ends of the scans of one sensor may vary
GEOMETRY = ("touch.head.", "touch.reports.mounts", "touch.reports.length", "touch.frontend.plugin")


class Sensor(NamedTuple):
    """A sensor. Views of two sessions can be compared only if their sensors agree (`disagreement`).

    Attributes:
        kind: of the sensor. view_shape: (R, C, K) of the views. whiskers: W, 0 without whiskers.
        unit: of the views' values. cell: side length of a pose cell, m, the unit of keyframe distances.
        geometry: of the whiskers, m and degrees. transform: settings that make views of readings; of a
            recording of finished views they are not known, and left out.
    """

    kind: str
    view_shape: tuple[int, int, int]
    whiskers: int
    unit: str
    cell: float
    geometry: dict[str, Any]
    transform: dict[str, Any]

    def describe(self) -> str:
        """The sensor in one line."""
        rows, columns, channels = self.view_shape
        count = f", {self.whiskers} whiskers" if self.whiskers else ""
        return f"{self.kind}{count}; views of {rows} x {columns} x {channels}, {self.unit}"

    @classmethod
    def of(cls, config: RunConfig, source: Source) -> Sensor:
        """The sensor of a configuration completed for its source.

        Args:
            source: its view shape is that of the observations; its info that of the readings or of the
                observations made of them.
        """
        info, touch = source.info, config.touch
        geometry: dict[str, Any] = {}
        if touch.frontend is not None:
            kind, made = OTHER_TOUCH, {"touch.frontend": touch.frontend.model_dump(mode="json")}
        elif info.labels_only:
            kind, made = LABELS, {}
        elif info.planar_whiskers is not None:
            reports = touch.reports.model_dump(mode="json")
            geometry = {f"touch.reports.{name}": reports[name] for name in ("mounts", "length")}
            kind, made = FIXED_WHISKERS, {"touch.reports.walls": reports["walls"]}
        elif info.pokes is not None:
            pokes = info.pokes.model_dump(mode="json", include={"reach", "bins", "radius"})
            kind, made = POKES, {f"touch.pokes.{name}": value for name, value in pokes.items()}
        elif source.whiskers:
            head = touch.head.model_dump(mode="json", exclude={"dead", "limit_deg"})
            geometry = {f"touch.head.{name}": value for name, value in head.items()}
            kind, made = WHISKER_HEAD, flat_settings(touch.image.model_dump(mode="json"), "touch.image.")
        else:
            recorded = info.provenance.get("views")  # of finished views that a live session has made
            kind, made = VIEWS, recorded if isinstance(recorded, dict) else views_of(config)[1]
        given = made | {f"templates.{name}": getattr(config.templates, name) for name in NORMALISATION}
        kept = [name for name in given if given[name] is not None or name.startswith("recording.")]
        # Lists for tuples, as a file gives them back.
        plain = json.loads(json.dumps([geometry, {name: given[name] for name in kept}]))
        unit, cell = UNITS[info.signed_views], config.pose_cells.cell_size
        return cls(kind, source.view_shape, source.whiskers, unit, cell, *plain)

    def disagreement(self, other: Sensor) -> str:
        """How another sensor differs from this one of a map, as a clause; '' if they agree."""
        found = [[("null" if each is None else each) for each in found] for found in self.differences(other)]
        clauses = [f"{what} is {others} and was {ours}" for what, ours, others in found]
        return f"{', '.join(clauses)} when the map was made" if clauses else ""

    def differences(self, other: Sensor) -> list[Difference]:
        """What differs between this sensor and another one. Settings that only one of them knows do not
        count; of sensors of two kinds, only the kind is named.
        """
        if self.kind != other.kind:
            return [(WORDS["kind"], self.kind, other.kind)]
        known = flat_settings(self.geometry | self.transform | {CELL: self.cell})
        others = flat_settings(other.geometry | other.transform | {CELL: other.cell})
        found = [(key, known[key], value) for key, value in others.items() if known.get(key, value) != value]
        shaped = any(what.endswith((".rows", ".columns")) for what, _, _ in found)
        for name in ("view_shape", "whiskers", "unit"):
            ours, theirs = getattr(self, name), getattr(other, name)
            if ours != theirs and not (shaped and name == "view_shape"):
                found.insert(0, (WORDS[name], ours, theirs))
        return found

    def check_same(self, where: str, other: Sensor) -> None:
        """Raises `InputError` with the reason if a map of this sensor cannot be used with another one, or
        with other settings of it.

        Args:
            where: the map, for the error.
        """
        reason = self.disagreement(other)
        if settings := settings_of_map(self.differences(other)):
            found = f"made with other settings of the sensor: {reason}"
            taken = f"`{assignments(settings)}` takes those of the map"
            cure = f"{taken}, and `doctor RECORDING --like {where}` too"
            raise InputError(where, found, "a map of these settings", cure)
        if reason:
            found = f"made with another sensor: {reason}"
            raise InputError(where, found, f"a map of this sensor ({other.kind})")


def settings_of_map(found: Sequence[Difference]) -> dict[str, Any] | None:
    """The settings that make a sensor that of a map; None if the device or its views differ beyond them."""
    if any(what in WORDS.values() or what.startswith(GEOMETRY) for what, _, _ in found):
        return None
    return {key: ours for key, ours, _ in found}


def check_same_fov(where: str, of_map: RunConfig, other: RunConfig) -> None:
    """Raises `InputError` if the recordings of two configurations see other angles, as far as they say so;
    views of two formats, such as a table and a bag, are only compared if both say it.

    Args:
        where: the map, for the error.
    """
    fovs = [config.recall.sector_fov for config in (of_map, other)]
    formats = [views_of(config)[0] for config in (of_map, other)]
    known = [fov for fov in fovs if not isinstance(fov, str)]
    same_format = formats[0] == formats[1] or "" in formats
    if not known or (abs(known[0] - known[1]) <= SAME_FOV if len(known) == 2 else same_format):
        return
    angles = ["an unknown angle" if isinstance(fov, str) else f"{fov:.4g} rad" for fov in fovs]
    ours, theirs = (f"{views or 'views'} over {angle}" for views, angle in zip(formats, angles, strict=True))
    cure = "if it is the same sensor, set recall.sector_fov in both configurations to its field of view"
    found = f"made with another sensor: {ours}, and not {theirs}"
    raise InputError(where, found, "a map of this sensor", cure)


def views_of(config: RunConfig) -> tuple[str, dict[str, Any]]:
    """What the views of a recording are made of, in words, '' where it does not say; and the settings by
    which its images or ranges became views, where it is not one of views."""
    recording = config.recording
    if recording is None:
        return "", {}
    image = flat_settings(recording.image.model_dump(mode="json"), "recording.image.")
    if recording.topics is not None:
        topic = recording.topics.views
        kept = {} if topic is None else topic.model_dump(include={"rows", "columns", "max_range", "heights"})
        return "topics of a bag", image | flat_settings(kept, "recording.topics.views.")
    if recording.file is not None and recording.file.suffix.lower() in VIDEO_SUFFIXES:
        return "frames of a video", image
    table = recording.table
    if table.views is None:
        return "", {}
    shape = {f"recording.table.{name}": getattr(table, name) for name in ("rows", "columns")}
    return "a table", shape | {"recording.table.views.max_range": table.views.max_range}
