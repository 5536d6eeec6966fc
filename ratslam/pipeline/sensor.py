"""The sensor of a map: what its views are measured with, and how they are made of the readings."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from ratslam.config.run_config import RunConfig
from robot.recordings.camera.video import SUFFIXES as VIDEO_SUFFIXES
from robot.sources.source import Source
from tactile.base.errors import InputError

WHISKER_HEAD, FIXED_WHISKERS, OTHER_TOUCH = "whisker head", "fixed whiskers", "registered touch sensor"
VIEWS, LABELS = "camera or laser", "given place labels"
UNITS = {True: "signed departures from rest, in the sensor's unit", False: "values in 0..1"}
NORMALISATION = ("source", "normalise_mean", "patch", "patch_sd")

WORDS = {
    "kind": "the sensor",
    "view_shape": "the shape of the views",
    "whiskers": "the number of whiskers",
    "unit": "the unit of the views",
    "cell": "pose_cells.cell_size",
}


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


def sensor_of(config: RunConfig, source: Source) -> Sensor:
    """The sensor of a configuration completed for its source.

    Args:
        source: its view shape is that of the observations; its info that of the readings or of the
            observations made of them.
    """
    info, touch = source.info, config.touch
    templates = {name: getattr(config.templates, name) for name in NORMALISATION}
    geometry: dict[str, Any] = {}
    if touch.frontend is not None:
        kind, made = OTHER_TOUCH, {"touch.frontend": touch.frontend.model_dump(mode="json")}
    elif info.labels_only:
        kind, made = LABELS, {}
    elif info.planar_whiskers is not None:
        reports = touch.reports.model_dump(mode="json")
        geometry = {f"touch.reports.{name}": reports[name] for name in ("mounts", "length")}
        kind, made = FIXED_WHISKERS, {"touch.reports.walls": reports["walls"]}
    elif source.whiskers:
        head = touch.head.model_dump(mode="json")
        geometry = {f"touch.head.{name}": head[name] for name in head if name not in ("dead", "limit_deg")}
        kind, made = WHISKER_HEAD, _settings("touch.image", touch.image)
    else:
        kind, made = VIEWS, _view_settings(config)
    transform = made | {f"templates.{name}": value for name, value in templates.items()}
    transform = {name: value for name, value in transform.items() if value is not None}
    plain = json.loads(json.dumps([geometry, transform]))  # lists for tuples, as a file gives them back
    unit, cell = UNITS[info.signed_views], config.pose_cells.cell_size
    return Sensor(kind, source.view_shape, source.whiskers, unit, cell, *plain)


def disagreement(of_map: Sensor, other: Sensor) -> str:
    """The first way in which another sensor differs from that of a map, as a clause; '' if they agree."""
    found = first_difference(of_map, other)
    if found is None:
        return ""
    what, ours, others = found
    return f"{what} is {others} and was {ours} when the map was made"


def first_difference(one: Sensor, other: Sensor) -> tuple[str, Any, Any] | None:
    """What differs first between two sensors, and its values; None if they agree.

    Settings that only one of them knows do not count.
    """
    for name in ("kind", "view_shape", "whiskers", "unit", "cell"):
        ours, others = getattr(one, name), getattr(other, name)
        if ours != others:
            return WORDS[name], ours, others
    known = one.geometry | one.transform
    for key, value in (other.geometry | other.transform).items():
        if known.get(key, value) != value:
            return key, known[key], value
    return None


def check_same_sensor(where: str, of_map: Sensor, other: Sensor) -> None:
    """Raises `InputError` with the reason if a map cannot be used with another sensor.

    Args:
        where: the map, for the error.
    """
    found = disagreement(of_map, other)
    if found:
        raise InputError(where, f"made with another sensor: {found}", f"a map of this sensor ({other.kind})")


def _settings(section: str, settings: Any) -> dict[str, Any]:
    return {f"{section}.{name}": value for name, value in settings.model_dump(mode="json").items()}


def _view_settings(config: RunConfig) -> dict[str, Any]:
    """Settings by which a recording's images or ranges became views, where it is not one of views."""
    recording = config.recording
    if recording is None:
        return {}
    image = _settings("recording.image", recording.image)
    if recording.topics is not None:
        topic = recording.topics.views
        kept = {} if topic is None else {"max_range": topic.max_range, "heights": list(topic.heights)}
        return image | {f"recording.topics.views.{name}": value for name, value in kept.items()}
    if recording.file.suffix.lower() in VIDEO_SUFFIXES:
        return image
    views = recording.table.views
    return {} if views is None else {"recording.table.views.max_range": views.max_range}
