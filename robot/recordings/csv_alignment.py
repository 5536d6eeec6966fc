"""Assigns views, place labels and truth, from the same or other files, to odometry rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from robot.recordings.alignment import interpolated_poses, nearest_rows, range_errors, range_pixels
from robot.recordings.csv_config import ContactColumns, LabelColumns, PairColumns, TruthColumns, ViewColumns
from robot.recordings.csv_file import CsvFile
from robot.recordings.input_judge import UnitLimits, heading_errors
from robot.recordings.sanity_checks import RowName, clock_errors, nonfinite_errors, view_errors
from robot.sources.source_info import PlanarWhiskersInfo
from tactile.base.errors import InputError

AlignedRows = tuple[np.ndarray, np.ndarray, list[InputError]]  # odometry rows [M], values [M, ...], errors


def align_views(
    base: CsvFile,
    files: Mapping[Path, CsvFile],
    part: ViewColumns,
    time: np.ndarray,
    shape: tuple[int, int, int],
) -> AlignedRows:
    """Views [M, R, C, 1]: pixels as given, or the mean range of equal groups of consecutive beams."""
    file = files[part.file or base.path]
    values, empty = file.block(part.prefix)
    there = np.flatnonzero(~empty.all(axis=1))
    place = _place(file, there)
    values = values[there]
    what, pixels, width = f"{part.prefix}*", int(np.prod(shape)), values.shape[1]
    if width % pixels or (part.max_range is None and width != pixels):
        expected = f"{pixels} (table.rows {shape[0]} x table.columns {shape[1]})"
        expected += "" if part.max_range is None else " or a multiple"
        error = InputError(f"{file.path}:1", f"{width} columns {part.prefix}0, {part.prefix}1, ...", expected)
        return there, values, [error]
    if part.max_range is None:
        errors = nonfinite_errors(values, what, place)
        errors += view_errors(values.min(axis=1), values.max(axis=1), what, place)
    else:
        values = np.where(np.isposinf(values), part.max_range, values)  # REP-117: no object in range
        errors = nonfinite_errors(values, what, place)
        typical = float(np.nanmedian(values)) if np.isfinite(values).any() else 0.0
        lowest, key = values.min(axis=1), "table.views.max_range"
        errors += range_errors(lowest, typical, part.max_range, what, place, str(file.path), key)
        values = range_pixels(values, pixels, part.max_range)
    rows, faults = _match_rows(file, base, there, part.time, part.tolerance, time)
    return rows, values.reshape(-1, *shape), errors + faults


def align_contacts(
    base: CsvFile, files: Mapping[Path, CsvFile], part: ContactColumns, time: np.ndarray
) -> AlignedRows:
    """Contacts [M, W] bool, in the order of the sensors in the settings."""
    file, names = files[part.file or base.path], tuple(part.directions)
    values = np.column_stack([file.column(name) for name in names])
    errors = file.faults(*names)
    bad = ~np.isin(values, (0, 1)) & np.isfinite(values)
    if bad.any():
        row, sensor = np.argwhere(bad)[0].tolist()
        found = f"{names[sensor]} is {values[row, sensor]:g}"
        errors.append(InputError(file.place(row), found, "1 in contact, 0 without"))
    rows, faults = _match_rows(file, base, np.arange(len(values)), part.time, part.tolerance, time)
    return rows, values == 1, errors + faults


def sensors_of(part: ContactColumns) -> PlanarWhiskersInfo:
    """The touch sensors as whiskers from the origin of base_link to what they touch."""
    mounts = tuple((0.0, 0.0, direction) for direction in part.directions.values())
    return PlanarWhiskersInfo(mounts=mounts, length=part.distance)


def align_labels(
    base: CsvFile,
    files: Mapping[Path, CsvFile],
    labels: LabelColumns | None,
    pairs: PairColumns | None,
    time: np.ndarray,
) -> AlignedRows:
    """Place labels [M] int32, given or derived from pairs."""
    if pairs is not None:
        return _labels_of_file(base, files[pairs.file], pairs, time)
    assert labels is not None
    file = files[labels.file or base.path]
    ids, empty = file.column(labels.column), file.empty[:, file.names.index(labels.column)]
    there = np.flatnonzero(~empty & (ids != -1))
    ids = ids[there]
    rows, errors = _match_rows(file, base, there, labels.time, labels.tolerance, time)
    bad = ~((ids >= 0) & (ids <= np.iinfo(np.int32).max) & (ids == np.round(ids)))
    if bad.any():
        row = int(bad.argmax())
        found, expected = f"{labels.column} is {ids[row]}", "an integer from 0; -1 or an empty cell for none"
        return rows, ids, [InputError(file.place(int(there[row])), found, expected), *errors]
    return rows, ids.astype(np.int32), errors


def _labels_of_file(base: CsvFile, file: CsvFile, part: PairColumns, time: np.ndarray) -> AlignedRows:
    later, earlier, score = (file.column(name) for name in (part.later, part.earlier, part.score))
    errors = file.faults(part.later, part.earlier, part.score)
    crossed = later <= earlier
    if crossed.any():
        row = int(crossed.argmax())
        found = f"{part.later} {later[row]} is not after {part.earlier} {earlier[row]}"
        cure = "swap table.pairs.later and earlier" if crossed.mean() > 0.5 else ""
        errors.append(InputError(file.place(row), found, "the later time of a pair first", cure))
    if errors:
        return later, later, errors
    moments, ids = labels_from_pairs(later.tolist(), earlier.tolist(), score.tolist(), part.threshold)
    rows, errors = each_nearest(moments, time, part.tolerance, lambda i: f"{file.path}, time {moments[i]}")
    return rows, ids, errors


def labels_from_pairs(
    later: Sequence[float], earlier: Sequence[float], score: Sequence[float], threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Place labels from pairs of times that a place recogniser matched.

    Every time is a view; its best earlier match passes on its label, without one the view is a new place.

    Args:
        later, earlier: s, the two times of each pair. score: similarity of each pair.
        threshold: smallest score of a match. Of equal scores the first pair is used.

    Returns:
        time: [V] s, increasing. label: [V] int32, places numbered in order of appearance.
    """
    best: dict[float, tuple[float, float]] = {}
    for time, match, value in zip(later, earlier, score, strict=True):
        if value >= threshold and (time not in best or value > best[time][0]):
            best[time] = value, match
    moments = np.unique(np.concatenate([later, earlier]))
    ids: dict[float, int] = {}
    places = 0
    for moment in moments.tolist():
        if moment in best:
            ids[moment] = ids[best[moment][1]]
        else:
            ids[moment], places = places, places + 1
    return moments, np.fromiter(ids.values(), np.int32, len(ids))


def align_truth(
    file: CsvFile, part: TruthColumns, time: np.ndarray, limits: UnitLimits, same_rows: bool
) -> tuple[np.ndarray, list[InputError]]:
    """True poses [N, 3] at times [N] s, NaN outside the time span of the truth.

    Args:
        file: that of the truth. same_rows: its rows are those of `time`.
    """
    names = (part.x, part.y, part.heading)
    errors = file.faults(*names)
    truth = np.column_stack([file.column(name) for name in names])
    moments = time if same_rows else file.column(part.time)
    if faults := heading_errors(truth[:, 2], moments, part.heading, str(file.path), limits):
        errors += faults
        truth[:, 2] = np.deg2rad(truth[:, 2])  # or every other check would report it again
    if same_rows:
        return truth, errors
    errors += file.faults(part.time) + clock_errors(moments, part.time, file.place)
    if errors:
        return np.full((len(time), 3), np.nan), errors
    truth, faults = interpolated_poses(time, moments, truth, part.time, str(file.path))
    return truth, errors + faults


def _match_rows(
    file: CsvFile, base: CsvFile, there: np.ndarray, name: str, tolerance: float | None, time: np.ndarray
) -> tuple[np.ndarray, list[InputError]]:
    """Odometry rows of the rows [M] of a file: the same, or the nearest in time."""
    if file is base:
        return there, []
    moments = file.column(name)[there]
    place = _place(file, there)
    errors = nonfinite_errors(moments, name, place) + clock_errors(moments, name, place)
    return (there, errors) if errors else each_nearest(moments, time, tolerance, place)


def _place(file: CsvFile, there: np.ndarray) -> RowName:
    """Positions of rows [M] of a file, for errors."""
    return lambda row: file.place(int(there[row]))


def each_nearest(
    moments: np.ndarray, time: np.ndarray, tolerance: float | None, place: RowName
) -> tuple[np.ndarray, list[InputError]]:
    """The odometry row nearest in time to each of the times [M], at most the tolerance away; each once.

    Args:
        moments: [M] s, increasing. time: [N] s, of the odometry rows. tolerance: s; None: the median step.
        place: names a row of `moments` in errors.
    """
    found = nearest_rows(moments, time, tolerance)
    if found is None:
        return np.zeros(len(moments), int), []  # the error of the clock is already reported
    rows, away, reach = found
    errors = []
    far = away > reach
    if far.any():
        i = int(far.argmax())
        text = f"the nearest odometry row is {away[i]:.4g} s away (one of {int(far.sum())} such rows)"
        cure = "raise tolerance, or bring both to one clock"
        errors.append(InputError(place(i), text, f"at most {reach:.4g} s", cure))
    twice = np.flatnonzero(np.diff(rows) == 0)
    if len(twice) and not errors:
        i = int(twice[0]) + 1
        text = f"belongs to the same odometry row as the previous one (one of {len(twice)} such rows)"
        errors.append(InputError(place(i), text, "one for each odometry row", "thin them out"))
    return rows, errors
