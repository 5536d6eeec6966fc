"""CSV recordings: odometry in one file; views, place labels and truth in the same or in other files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from robot.recordings.alignment import RecordingRows
from robot.recordings.csv_alignment import (
    align_contacts,
    align_labels,
    align_truth,
    align_views,
    column_keys,
    leave_out,
    position_columns,
    read_poses,
    rounded_rate,
    sensors_of,
)
from robot.recordings.csv_config import (
    CsvConfig,
    MotionColumns,
    PoseColumns,
    VelocityColumns,
    ViewColumns,
)
from robot.recordings.csv_file import CsvFile, digest_of_files, read_csv
from robot.recordings.sanity_checks import clock_errors
from robot.recordings.unit_check import DEFAULT_LIMITS, UnitLimits
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import missing_error, raise_errors
from robot.sources.odometry import from_motions, from_poses, from_velocities
from robot.sources.registry import Warn
from tactile.base.errors import InputError

ODOMETRY = ("pose", "velocity", "motion")
"""Parts of the table of which one is given."""
HOLE = 3
"""Rows one after another that may be left out of velocities and motions; the next row stands for them."""
MAX_PIXELS = 1 << 26
"""Of all views of a recording."""


def read_csv_recording(
    path: Path, config: CsvConfig, limits: UnitLimits = DEFAULT_LIMITS, warn: Warn = None
) -> InMemorySource:
    """A CSV recording as a `Source`: one sample per row of the odometry file.

    Args:
        warn: called with one sentence, `PATH:LINE: ...`, where rows, views or true poses are left out.

    Raises:
        InputError: files or columns are missing, too many cells are not numbers, or values are impossible.
    """
    parts = (config.views, config.contacts, config.labels, config.pairs, config.truth)
    paths = [path, *(part.file for part in parts if part is not None and part.file is not None)]
    files = {name: read_csv(name, config.units.time) for name in dict.fromkeys(paths)}
    raise_errors(_absences(files[path], files, config))

    base, kept, errors = _odometry_rows(files[path], config, warn)
    files[path] = base
    time, faults = _times(base, config, kept)
    motion, others = _motion(base, time, config, kept, limits)
    size = len(time) * config.rows * config.columns
    if size > MAX_PIXELS:
        found = f"{len(time)} rows of {config.rows} x {config.columns} pixels"
        raise InputError(str(path), found, f"at most {MAX_PIXELS}", "lower table.rows or table.columns")
    recording = RecordingRows(time, motion, (config.rows, config.columns, 1), errors=errors + faults + others)
    if config.views is not None:
        rows, values, faults = align_views(base, files, config.views, time, recording.shape, warn)
        recording.errors += faults
        if not faults:
            recording.views[rows], recording.seen[rows] = values, True
    if config.contacts is not None:
        rows, values, faults = align_contacts(base, files, config.contacts, time)
        recording.errors += faults
        if not faults:
            recording.set_contacts(rows, values, sensors_of(config.contacts))
    if config.labels is not None or config.pairs is not None:
        rows, values, faults = align_labels(base, files, config.labels, config.pairs, time)
        recording.errors += faults
        if not faults:
            recording.label[rows] = values
    if config.truth is not None:
        file = files[config.truth.file or path]
        recording.truth, faults = align_truth(file, config.truth, time, limits, file is base, warn)
        recording.errors += faults
    return recording.source(path.stem, digest_of_files(list(files.values())), str(path), limits)


def _odometry_rows(
    base: CsvFile, config: CsvConfig, warn: Warn
) -> tuple[CsvFile, np.ndarray, list[InputError]]:
    """The file without rows that lack a number of the odometry, positions of the others, and errors."""
    part = _odometry_part(config)
    clock = [] if config.rate is not None else [config.time]
    if isinstance(part, PoseColumns):
        names, turn = position_columns(part)
    else:
        names, turn = [name for name in part.model_dump().values() if name is not None], []
    bad, errors = base.judge([*clock, *names], turn)
    if not leave_out(bad, errors, "rows are", warn):
        return base, np.arange(len(bad)), errors
    kept = np.flatnonzero(~bad)
    hole = int(np.diff(kept).max(initial=1)) - 1
    if hole > HOLE and not isinstance(part, PoseColumns):
        row = int(kept[np.diff(kept).argmax()]) + 1
        found = f"{hole} rows one after another lack odometry ({errors[0].found})"
        error = InputError(base.place(row), found, f"at most {HOLE}, which the next row covers")
        return base, np.arange(len(bad)), [error]
    return base.rows(kept), kept, []


def _odometry_part(config: CsvConfig) -> PoseColumns | VelocityColumns | MotionColumns:
    part = config.pose or config.velocity or config.motion
    assert part is not None  # checked by `_absences`
    return part


def _times(base: CsvFile, config: CsvConfig, kept: np.ndarray) -> tuple[np.ndarray, list[InputError]]:
    """Times [N] s of the rows at positions [N], and their errors."""
    if config.rate is not None:
        there = config.time in (*base.names, *base.header.full)
        time = base.column(config.time, "time", config.units.time) if there else np.zeros(1)
        return np.nan_to_num(time[0]) + kept / config.rate, []
    time = base.column(config.time, "time", config.units.time)
    rate = rounded_rate(time, base.values)
    if rate is None:
        return time, clock_errors(time, config.time, base.place)
    found = f"{config.time} is rounded: {len(time) / len(np.unique(time)):.3g} rows share each time"
    cure = f"set recording.table.rate={rate:.6g}, the rows per second, or write more digits"
    row = int((np.diff(time) == 0).argmax()) + 1
    return time, [InputError(base.place(row), found, "times that increase", cure)]


def _absences(base: CsvFile, files: Mapping[Path, CsvFile], config: CsvConfig) -> list[InputError]:
    """Errors for missing columns and for settings that contradict each other."""
    errors = base.absences([(config.time, "table.time")] if config.rate is None else [])
    given = sum(getattr(config, key) is not None for key in ODOMETRY)
    if given != 1:
        found = f"{'more than one' if given else 'none'} of {', '.join(f'table.{key}' for key in ODOMETRY)}"
        expected = f"one of them, naming the odometry among {', '.join(base.names[:12])}"
        errors.append(InputError(str(base.path), found, expected))
    if config.labels is not None and config.pairs is not None:
        found = "both table.labels and table.pairs are given"
        errors.append(InputError(str(base.path), found, "one of them"))
    for key in (*ODOMETRY, "contacts", "labels", "pairs", "truth", "views"):
        part = getattr(config, key)
        if part is None:
            continue
        file = files[getattr(part, "file", None) or base.path]
        own_time = file is base and hasattr(part, "time")  # then that of the odometry is used
        errors += file.absences(column_keys(part, f"table.{key}")[own_time:])
        if isinstance(part, ViewColumns):
            errors += _gap_errors(file, part.prefix)
    return errors


def _gap_errors(file: CsvFile, prefix: str) -> list[InputError]:
    """The error for view columns whose numbers have a gap."""
    there = file.numbered(prefix)
    wanted = range(min(there), max(there)) if there else [0]
    absent = next((number for number in wanted if number not in there), None)
    if absent is None:
        return []
    return [missing_error(file.top, "column", f"{prefix}{absent}", file.names, "table.views.prefix")]


def _motion(
    base: CsvFile, time: np.ndarray, config: CsvConfig, kept: np.ndarray, limits: UnitLimits
) -> tuple[np.ndarray, list[InputError]]:
    """Motions [N, 4] of the rows at positions [N], and their errors."""
    part, units = _odometry_part(config), config.units
    with np.errstate(all="ignore"):  # faulty values are already reported
        if isinstance(part, PoseColumns):
            poses, errors = read_poses(base, part, units, time, limits, "table.pose")
            return from_poses(time, poses), errors
        rate = "/time" if isinstance(part, VelocityColumns) else ""
        convert = from_velocities if rate else from_motions
        length, angle = (unit and unit + rate.replace("time", "s") for unit in (units.length, units.angle))
        forward, turn = (
            base.column(part.forward, f"length{rate}", length),
            base.column(part.turn, f"angle{rate}", angle),
        )
        left = base.column(part.left, f"length{rate}", length) if part.left is not None else 0.0
        spans = np.diff(kept, prepend=kept[:1] - 1)
        if not rate and (spans > 1).any():  # a row covers those left out before it, as a velocity does
            forward, left, turn = forward * spans, left * spans, turn * spans
        return convert(time, forward, left, turn), []
