"""CSV recordings: odometry in one file; views, place labels and truth in the same or in other files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from robot.recordings.alignment import RecordingRows
from robot.recordings.csv_alignment import align_contacts, align_labels, align_truth, align_views, sensors_of
from robot.recordings.csv_config import ContactColumns, CsvConfig, PoseColumns, VelocityColumns, ViewColumns
from robot.recordings.csv_file import CsvFile, digest_of_files, read_csv
from robot.recordings.input_judge import DEFAULT_JUDGE, InputJudge, UnitLimits, heading_errors
from robot.recordings.sanity_checks import clock_errors
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import missing_error, raise_errors
from robot.sources.odometry import from_motions, from_poses, from_velocities
from tactile.base.errors import InputError

ODOMETRY = ("pose", "velocity", "motion")
"""Parts of the table of which one is given."""


def read_csv_recording(path: Path, config: CsvConfig, judge: InputJudge = DEFAULT_JUDGE) -> InMemorySource:
    """A CSV recording as a `Source`: one sample per row of the odometry file.

    Raises:
        InputError: files or columns are missing, cells are not numbers, or values are impossible.
    """
    parts = (config.views, config.contacts, config.labels, config.pairs, config.truth)
    paths = [path, *(part.file for part in parts if part is not None and part.file is not None)]
    files = {name: read_csv(name) for name in dict.fromkeys(paths)}
    base = files[path]
    raise_errors(_absences(base, files, config))

    time, limits = base.column(config.time), judge.limits
    errors = base.faults(config.time) + clock_errors(time, config.time, base.place)
    motion, faults = _motion(base, time, config, limits)
    recording = RecordingRows(time, motion, (config.rows, config.columns, 1), errors=errors + faults)
    recording.held, recording.place = config.velocity is not None, base.place
    if config.pose is not None:
        recording.poses = np.column_stack([base.column(name) for name in config.pose.model_dump().values()])
    if config.views is not None:
        rows, values, faults = align_views(base, files, config.views, time, recording.shape)
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
        recording.truth, faults = align_truth(file, config.truth, time, limits, file is base)
        recording.errors += faults
    return recording.source(path.stem, digest_of_files(list(files.values())), str(path), judge)


def _absences(base: CsvFile, files: Mapping[Path, CsvFile], config: CsvConfig) -> list[InputError]:
    """Errors for missing columns and for settings that contradict each other."""
    errors = base.absences([(config.time, "table.time")])
    given = sum(getattr(config, key) is not None for key in ODOMETRY)
    if given != 1:
        found = f"{'more than one' if given else 'none'} of {', '.join(f'table.{key}' for key in ODOMETRY)}"
        expected = f"one of them, naming the odometry among {', '.join(base.names)}"
        errors.append(InputError(str(base.path), found, expected))
    if config.labels is not None and config.pairs is not None:
        found = "both table.labels and table.pairs are given"
        errors.append(InputError(str(base.path), found, "one of them"))
    for key in (*ODOMETRY, "contacts", "labels", "pairs", "truth", "views"):
        part = getattr(config, key)
        if part is None:
            continue
        file = files[getattr(part, "file", None) or base.path]
        numbers = {"file", "tolerance", "threshold", "prefix", "max_range", "directions", "distance"}
        named = part.model_dump(exclude=numbers, exclude_none=True)
        if file is base:
            named.pop("time", None)  # the time of the odometry is used there
        errors += file.absences([(column, f"table.{key}.{field}") for field, column in named.items()])
        if isinstance(part, ContactColumns):
            key = "contacts.directions"
            errors += file.absences([(column, f"table.{key}") for column in part.directions])
        if isinstance(part, ViewColumns):
            errors += _gap_errors(file, part.prefix)
    return errors


def _gap_errors(file: CsvFile, prefix: str) -> list[InputError]:
    """The error for view columns whose numbers have a gap."""
    there = list(file.numbered(prefix))
    wanted = range(there[0], there[-1]) if there else [0]
    absent = next((number for number in wanted if number not in there), None)
    if absent is None:
        return []
    return [missing_error(f"{file.path}:1", "column", f"{prefix}{absent}", file.names, "table.views.prefix")]


def _motion(
    base: CsvFile, time: np.ndarray, config: CsvConfig, limits: UnitLimits
) -> tuple[np.ndarray, list[InputError]]:
    """Motions [N, 4] and the errors of their columns."""
    part = config.pose or config.velocity or config.motion
    assert part is not None  # checked by `_absences`
    names = [name for name in part.model_dump().values() if name is not None]
    columns = {name: base.column(name) for name in names}
    errors = base.faults(*names)
    with np.errstate(all="ignore"):  # faulty values are already reported
        if isinstance(part, PoseColumns):
            poses = np.column_stack([columns[name] for name in names])
            if faults := heading_errors(poses[:, 2], time, part.heading, str(base.path), limits):
                errors += faults
                poses[:, 2] = np.deg2rad(poses[:, 2])  # or every other check would report it again
            return from_poses(time, poses), errors
        left = columns[part.left] if part.left is not None else 0.0
        convert = from_velocities if isinstance(part, VelocityColumns) else from_motions
        return convert(time, columns[part.forward], left, columns[part.turn]), errors
