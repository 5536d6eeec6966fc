"""What a recording holds, whether it can be read, and the configuration that reads it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ratslam.runs.map_settings import differing_settings
from ratslam.runs.open_source import open_source
from ratslam.runs.saved_map import SavedMap
from ratslam.runs.sensor import check_same_fov, check_same_sensor, differences, sensor_of, settings_of_map
from ratslam.runs.settings.completion import complete
from ratslam.runs.settings.other_files import FOLDER, RECORDING, kind_of, refuse_other_files
from ratslam.runs.settings.run_config import RunConfig
from ratslam.runs.settings.strict_yaml import dump_data, override, parse, validate
from ratslam.service.doctor.diagnosis import Diagnosis
from ratslam.service.doctor.recording_kinds import describe_file
from ratslam.service.fit.record import shows_place
from robot.recordings.bags.bag import METADATA
from robot.recordings.input_judge import MotionTrack, TypicalMotion, typical_motion
from robot.sources.source import Source
from robot.sources.source_registry import SOURCES
from tactile.base.errors import InputError

CELLS_IN_RANGE = 13
"""Pose cells in the range of the sensor, as in the configurations of real buildings."""
DEFAULT_CELL = 0.1
"""Side of a pose cell of a robot that does not move, m."""
TORUS = 61
"""Cells along x and y: buildings overlap less on a larger torus, and a step costs no more."""
UNREADABLE = "no configuration reads it: see what is missing"


class Contents(NamedTuple):
    """What a source holds.

    Attributes:
        samples, views: numbers of samples, and of those with a view or label. motion: typical; None for
            a single sample. path: m. step: median motion between two views, m. truth: share of the samples
            with a true pose. view_shape: of the views. whiskers: number.
    """

    samples: int
    views: int
    motion: TypicalMotion | None
    path: float
    step: float
    truth: float
    view_shape: tuple[int, int, int]
    whiskers: int


def diagnose_recording(path: Path, like: SavedMap | None = None) -> Diagnosis:
    """What a recording is, whether it can be read, and the configuration that reads it.

    Args:
        like: a map; the configuration then has its view, cells and method. Another sensor is a fault.

    Raises:
        InputError: it is missing, or of no known format.
    """
    path = path.parent if path.name == METADATA and kind_of(path.parent) == RECORDING else path
    refuse_other_files(path, "a recording", (RECORDING, FOLDER))
    if path.is_file() and path.suffix.lower() in (".yaml", ".yml"):
        cure = f"`run {path}` maps what it names, `doctor --live {path}` checks its robot"
        raise InputError(str(path), "a configuration", "a recording or a run directory", cure)
    try:
        found = describe_file(path)
    except InputError:
        if path.is_file() and (diagnosis := diagnose_registered(path)):
            return diagnosis
        raise
    if found.recording is None:
        if diagnosis := diagnose_registered(path):
            return diagnosis
        return Diagnosis(found.what, found.table, found.notes, found.faults or (UNREADABLE,))
    sections: dict[str, Any] = {"recording": {"file": str(path.resolve()), **found.recording}}
    if "visual_odometry" in found.recording:
        sections["presets"] = ["visual_odometry"]
    told, faults, contents = list[str](), found.faults, None
    try:
        if like is not None:
            fov = found.field_of_view
            sections = _alike(sections if fov is None else sections | {"recall": {"sector_fov": fov}}, like)
        with open_source(validate(parse(dump_data(sections), path.name), RunConfig), told.append) as source:
            contents = summarise(source)
    except InputError as error:
        faults = (*faults, *str(error).splitlines())
    if like is None and not (contents and contents.whiskers):
        cell = cell_size(contents.step if contents else 0.0, found.max_range)
        sections["pose_cells"] = {"cells_xy": TORUS, "cell_size": cell}
        if found.field_of_view is not None:
            sections["recall"] = {"sector_fov": round(found.field_of_view, 4)}
    notes = (*found.notes, *told, *(facts(contents) if contents else ()))
    return Diagnosis(
        found.what, found.table, notes, faults, shortcomings(contents) if contents else (), sections
    )


def _alike(sections: dict[str, Any], like: SavedMap) -> dict[str, Any]:
    """The sections with all settings in which the view, the cells or the method of a map differ from theirs.

    Raises:
        InputError: the recording is of another sensor.
    """
    name = f"doctor --like {like.path}"
    document = override(parse(dump_data(sections), name), [f"backend={like.config.backend}"])
    given = validate(document, RunConfig)
    check_same_fov(str(like.path), like.config, given)
    with open_source(given) as source:
        config = complete(given, source)
        found = differences(like.sensor, sensor_of(config, source))
    settings = settings_of_map(found)
    if settings is None:
        check_same_sensor(str(like.path), like.sensor, sensor_of(config, source))
    method = differing_settings([like.config, config])
    settings = {key: both[0] for key, both in method.items()} | (settings or {})
    return override(document, [f"{key}={json.dumps(value)}" for key, value in settings.items()]).data


def diagnose_registered(path: Path) -> Diagnosis | None:
    """A recording that a registered source reads, whose only setting without default is `file`; None if no
    source does."""
    for name in SOURCES.names():
        settings = {"plugin": name, "settings": {"file": str(path.resolve())}}
        try:
            fields = SOURCES.get(name, "source").config_class.model_fields
            if [key for key, field in fields.items() if field.is_required()] != ["file"]:
                continue
            sections = {"source": settings}
            with open_source(validate(parse(dump_data(sections), path.name), RunConfig)) as source:
                contents = summarise(source)
        except Exception:  # whatever a package does with a file that is not its own
            continue
        what = f"{path}: a recording that the source {name} reads"
        return Diagnosis(what, notes=facts(contents), advice=shortcomings(contents), config=sections)
    return None


def summarise(source: Source) -> Contents:
    """Reads all samples of a source."""
    motions, times, truths, views = [], [], 0, []
    for sample in source:
        motions.append(np.asarray(sample.reading.odometry, float))
        times.append(sample.time)
        truths += sample.truth is not None
        views.append(shows_place(sample.reading))
    motion, time, viewed = np.array(motions).reshape(-1, 4), np.array(times), np.array(views, bool)
    length = np.hypot(motion[:, 0], motion[:, 1])
    between = np.diff(np.cumsum(length)[viewed])
    moved = between[between > 0]
    track = MotionTrack(time, np.ones(len(time), bool), motion, None)
    return Contents(
        samples=len(time),
        views=int(viewed.sum()),
        motion=typical_motion(track) if len(time) > 1 else None,
        path=float(length.sum()),
        step=float(np.median(moved)) if len(moved) else 0.0,
        truth=truths / max(len(time), 1),
        view_shape=source.view_shape,
        whiskers=source.whiskers,
    )


def cell_size(step: float, max_range: float) -> float:
    """Side of a pose cell, m, to two digits: a share of the sensor's range, else the motion between views.

    Args:
        step: median motion between two views, m. max_range: of the sensor, m, NaN without one.
    """
    size = max_range / CELLS_IN_RANGE if np.isfinite(max_range) else step or DEFAULT_CELL
    return float(f"{size:.2g}")


def facts(contents: Contents) -> tuple[str, ...]:
    """The contents in words."""
    notes = []
    if contents.motion is not None:
        notes.append(
            f"odometry: {contents.path:.3g} m, typically {contents.motion.speed:.2g} m/s and "
            f"{contents.motion.turn_rate:.2g} rad/s, a sample every {contents.motion.interval:.2g} s"
        )
    shape = " x ".join(map(str, contents.view_shape[:2]))
    kind = f"of {contents.whiskers} whiskers" if contents.whiskers else f"of {shape} values"
    notes.append(f"views: {contents.views} {kind}, {contents.step:.2g} m apart")
    notes.append(f"truth: for {contents.truth:.0%} of the samples" if contents.truth else "truth: unknown")
    return tuple(notes)


def shortcomings(contents: Contents) -> tuple[str, ...]:
    """What the recording lacks for a good map, in words."""
    advice = []
    if not contents.views:
        advice.append("without views or place labels no place is recognised: the map is the odometry")
    if contents.path == 0:
        advice.append("the odometry does not move: check its topic or columns")
    return tuple(advice)
