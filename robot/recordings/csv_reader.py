"""CSV recordings: odometry in one file; views, place labels and truth in the same or in other files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robot.recordings import alignment, sanity_checks
from robot.recordings import csv_config as columns
from robot.recordings.csv_config import split_unit
from robot.recordings.csv_file import EMPTY, CsvFile, read_csv
from robot.recordings.input_judge import DEFAULT_JUDGE, InputJudge, UnitLimits, heading_errors
from robot.recordings.sanity_checks import RowName, clock_errors, first_error
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import digest_of, missing_error, raise_errors
from robot.sources.odometry import from_motions, from_poses, from_velocities
from robot.sources.source import PlanarWhiskersInfo, SourceInfo, Warn
from tactile.base.errors import InputError
from tactile.base.settings import Settings

ODOMETRY = ("pose", "velocity", "motion")
"""Parts of the table of which one is given."""
RATE = "--set recording.table.rate={:.6g}, the rows per second"
AlignedRows = tuple[np.ndarray, np.ndarray, list[InputError]]  # odometry rows [M], values [M, ...], errors


class _Files(NamedTuple):
    """The files of a recording.

    Attributes:
        base: that of the odometry, with the rows that are used. others: all by path. time: [N] s of the rows
            of the odometry, also of those left out. warn: is told where rows of a file are left out.
    """

    base: CsvFile
    others: Mapping[Path, CsvFile]
    time: np.ndarray
    warn: Warn

    def of(self, file: Path | None) -> CsvFile:
        """The file of a part of the table."""
        return self.others[file or self.base.path]


def read_csv_recording(
    path: Path, config: columns.CsvConfig, judge: InputJudge = DEFAULT_JUDGE
) -> InMemorySource:
    """A CSV recording as a `Source`: one sample per row of the odometry file.

    Args:
        judge: of the odometry; is told, `PATH:LINE: ...`, where rows, views or true poses are left out.

    Raises:
        InputError: files or columns are missing, too many cells are not numbers, or values are impossible.
    """
    parts = (config.views, config.contacts, config.labels, config.pairs, config.truth)
    paths = [path, *(part.file for part in parts if part is not None and part.file is not None)]
    found = {name: read_csv(name, config.units.time) for name in dict.fromkeys(paths)}
    raise_errors(_absences(found[path], found, config))
    digest, warn = digest_of(file.content for file in found.values()), judge.warn
    if judge.stretch != sanity_checks.WHOLE:
        found = _within(found, path, config, judge.stretch)

    whole, part = found[path], config.pose or config.velocity or config.motion
    assert part is not None  # checked by `_absences`
    names = [name for name, _ in column_keys(part, "")]
    stamps = config.time if config.rate is None else ""
    # So many rows of velocities or motions one after another may be left out; the next row stands for them.
    turn, hole = (part.quaternion, np.inf) if isinstance(part, columns.PoseColumns) else (None, 3)
    kept, errors = _sound_rows(whole, names, "rows", warn, stamps, turn or (), hole=hole)
    base = found[path] = whole.rows(kept)
    if config.rate is None:
        time = base.column(config.time, "time", config.units.time)
        errors += _clock_errors(base, config.time, time, RATE)
    else:
        there = config.time in (*base.names, *base.full)
        start = base.column(config.time, "time", config.units.time)[0] if there else 0.0
        time = np.nan_to_num(start) + kept / config.rate
    motion, poses, faults = _motion(base, time, kept, config, judge.limits)
    shape, held = (config.rows, config.columns, 1), isinstance(part, columns.VelocityColumns)
    errors += faults
    source = alignment.blank_rows(path, time, motion, shape)
    # What belongs to a row that is left out, is left out too.
    every, rows = time, np.arange(len(whole.lines))
    if len(kept) < len(rows):  # the times of rows that are left out lie between those of their neighbours
        step = float(np.median(np.diff(time) / np.diff(kept))) if len(kept) > 1 else 1.0
        beyond = np.minimum(rows - kept[0], 0) + np.maximum(rows - kept[-1], 0)
        every = np.interp(rows, kept, time) + beyond * step
    files = _Files(base, found, every, warn)
    row_of = np.full(len(files.time), -1)
    row_of[kept] = np.arange(len(kept))

    def placed(file: Path | None, aligned: AlignedRows) -> tuple[np.ndarray, np.ndarray]:
        """The values without errors whose row is kept, and its number."""
        rows, values, faults = aligned
        errors.extend(faults)
        if faults:
            return np.zeros(0, int), values[:0]
        rows = rows if files.of(file) is base else row_of[rows]
        return rows[rows >= 0], values[rows >= 0]

    if config.views is not None:
        rows, values = placed(config.views.file, _views(files, config.views, shape))
        source["views"][rows], source["seen"][rows] = values.reshape(-1, *shape), True
    if config.contacts is not None:
        rows, values = placed(config.contacts.file, _contacts(files, config.contacts))
        source |= _touch(config.contacts, rows, values, len(time))
    if config.pairs is not None:
        rows, source["label"][rows] = placed(config.pairs.file, _pairs(files, config.pairs))
    elif config.labels is not None:
        rows, source["label"][rows] = placed(config.labels.file, _labels(files, config.labels))
    if config.truth is not None:
        file = files.of(config.truth.file)
        same, clock = file is base, time if file is base else files.time
        truth, faults = align_truth(file, config.truth, clock, judge, same)
        source["truth"] = truth if same else truth[kept]
        errors.extend(faults)
    ids_alone = bool((source["label"] >= 0).any()) and not source["seen"].any()
    info = SourceInfo(labels_only=ids_alone, planar_whiskers=source.pop("sensors", None))
    cures = "--set recording.table.units.{}={}".format
    found_all = InMemorySource(digest=digest, info=info, **source)
    return alignment.judged(found_all, errors, judge, str(path), base.place, held, poses, cures)


def _within(
    files: Mapping[Path, CsvFile], path: Path, config: columns.CsvConfig, stretch: sanity_checks.Stretch
) -> dict[Path, CsvFile]:
    """The files, each with its rows within a stretch of the odometry."""
    base, found = files[path], dict(files)
    if config.rate is None:
        time = base.column(config.time, "time", config.units.time)
    else:
        time = np.arange(len(base.lines)) / config.rate
    inside = stretch.rows(time, str(path))
    found[path] = base.rows(inside)
    first, last = time[inside][0], time[inside][-1]
    for part in (config.views, config.contacts, config.labels, config.pairs, config.truth):
        if part is None or part.file is None or part.file == path:
            continue
        names = (part.later, part.earlier) if isinstance(part, columns.PairColumns) else (part.time,)
        file = files[part.file]
        times = np.column_stack([file.column(name, "time") for name in names])
        found[part.file] = file.rows(((first <= times) & (times <= last)).all(axis=1))
    return found


def _clock_errors(file: CsvFile, name: str, time: np.ndarray, cure: str) -> list[InputError]:
    """Errors of times [N] s that do not increase; `cure`: for rounded ones, with their rate."""
    rate = rounded_rate(time, file.values)
    if rate is None:
        return clock_errors(time, name, file.place)
    found = f"{name} is rounded: {len(time) / len(np.unique(time)):.3g} rows share each time"
    row = int((np.diff(time) == 0).argmax()) + 1
    return [InputError(file.place(row), found, "times that increase", cure.format(rate))]


def _absences(base: CsvFile, files: Mapping[Path, CsvFile], config: columns.CsvConfig) -> list[InputError]:
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
        if isinstance(part, columns.ViewColumns):
            there = file.numbered(part.prefix)
            wanted = range(min(there), max(there)) if there else [0]
            absent = next((number for number in wanted if number not in there), None)
            if absent is not None:
                name = f"{part.prefix}{absent}"
                errors.append(missing_error(file.top, "column", name, file.names, "table.views.prefix"))
    return errors


def _motion(
    base: CsvFile, time: np.ndarray, kept: np.ndarray, config: columns.CsvConfig, limits: UnitLimits
) -> tuple[np.ndarray, np.ndarray | None, list[InputError]]:
    """Motions [N, 4] of the rows at positions [N], poses [N, 3] where these are given, and errors."""
    units, part = config.units, config.pose or config.velocity or config.motion
    assert part is not None
    with np.errstate(all="ignore"):  # faulty values are already reported
        if isinstance(part, columns.PoseColumns):
            poses, errors = _read_poses(base, part, units, time, limits, "table.pose")
            return from_poses(time, poses), poses, errors
        rate, per = ("/time", "/s") if isinstance(part, columns.VelocityColumns) else ("", "")
        length, angle = (unit and unit + per for unit in (units.length, units.angle))
        forward = base.column(part.forward, f"length{rate}", length)
        left = base.column(part.left, f"length{rate}", length) if part.left is not None else 0.0
        turn = base.column(part.turn, f"angle{rate}", angle)
        spans = np.diff(kept, prepend=kept[:1] - 1)
        if not rate and (spans > 1).any():  # a row stands for those left out before it, as a velocity does
            forward, left, turn = forward * spans, left * spans, turn * spans
        return (from_velocities if rate else from_motions)(time, forward, left, turn), None, []


def _sound_rows(
    file: CsvFile,
    names: Sequence[str],
    what: str,
    warn: Warn,
    time: str = "",
    quaternion: Sequence[str] = (),
    far: bool = False,
    hole: float = np.inf,
) -> tuple[np.ndarray, list[InputError]]:
    """The rows that have all numbers; if too many others are to be left out with a warning, all and errors.

    Args:
        names, quaternion, far: as for `CsvFile.judge`. time: column of times, which increase; '' for none.
        hole: how many rows one after another may be left out.
    """
    bad, errors = file.judge([*names, *([time] if time else [])], quaternion, far)
    if time:
        moments = file.column(time)
        latest = np.maximum.accumulate(np.where(bad, -np.inf, moments))
        late = ~bad & np.append(False, moments[1:] <= latest[:-1])
        set_back = (late[1:] & late[:-1]).any() and hole < np.inf  # without its rows their motion is lost
        if late.any() and (bad | late).sum() <= max(1, sanity_checks.SPOILT * len(bad)) and not set_back:
            bad, errors = bad | late, errors + clock_errors(moments, time, file.place)
    kept = np.flatnonzero(~bad)
    many = np.diff(kept).max(initial=0) > hole + 1
    if bad.any() and (many or sanity_checks.leave_out(int(bad.sum()), len(bad), what, errors[0], warn)):
        return np.arange(len(bad)), errors
    return kept, []


def rounded_rate(time: np.ndarray, rows: np.ndarray) -> float | None:
    """Rows per second if rows share times because those are rounded, else None.

    Args:
        time: [N] s. rows: [N, C] what the rows hold; rows that only repeat the one before are no sign.
    """
    steps = np.diff(time)
    change, same = np.flatnonzero(steps > 0) + 1, steps == 0
    if len(change) < 2 or (steps < 0).any() or same.mean() < 0.2:
        return None
    repeated = (np.nan_to_num(np.diff(rows, axis=0)[same]) == 0).all(axis=1)
    if repeated.mean() > 0.5:
        return None
    return float((change[-1] - change[0]) / (time[change[-1]] - time[change[0]]))


def _views(files: _Files, part: columns.ViewColumns, shape: tuple[int, int, int]) -> AlignedRows:
    """Views [M, R, C, 1]: pixels as given, or the mean range of equal groups of consecutive beams."""
    file = files.of(part.file)
    there = np.flatnonzero(~(file.block(part.prefix)[1] == EMPTY).all(axis=1))
    beams = [file.full[place] for place in file.numbered(part.prefix).values()]
    what, pixels, width = f"{part.prefix}*", int(np.prod(shape)), len(beams)
    if width % pixels or (part.max_range is None and width != pixels):
        expected = f"{pixels} (table.rows {shape[0]} x table.columns {shape[1]})"
        expected += "" if part.max_range is None else " or a multiple"
        error = InputError(file.top, f"{width} columns {part.prefix}0, {part.prefix}1, ...", expected)
        return there, file.values, [error]
    seen = file.rows(there)
    clock = "" if file is files.base else part.time
    good, errors = _sound_rows(seen, beams, "views", files.warn, clock, far=part.max_range is not None)
    if errors:
        return there, file.values, errors
    there, seen = there[good], seen.rows(good)
    values, errors = seen.block(part.prefix, part.unit)[0], []
    if part.max_range is None:
        errors += sanity_checks.view_errors(values.min(axis=1), values.max(axis=1), what, seen.place)
    else:
        values = np.where(np.isposinf(values), part.max_range, values)  # REP-117: no object in range
        typical = float(np.median(values)) if len(values) else 0.0
        low, key = values.min(axis=1), "table.views.max_range"
        errors += alignment.range_errors(low, typical, part.max_range, what, seen.place, str(file.path), key)
        values = alignment.range_pixels(values, pixels, part.max_range)
    rows, faults = _match_rows(files, file, there, part)
    return rows, values.reshape(-1, *shape), errors + faults


def _contacts(files: _Files, part: columns.ContactColumns) -> AlignedRows:
    """Contacts [M, W] bool, in the order of the sensors in the settings."""
    file, names = files.of(part.file), tuple(part.directions)
    there, errors = _sound_rows(file, names, "contacts", files.warn)
    values = np.column_stack([file.column(name)[there] for name in names])
    bad = ~np.isin(values, (0, 1)) & np.isfinite(values)
    if bad.any():
        row, sensor = np.argwhere(bad)[0].tolist()
        found = f"{names[sensor]} is {values[row, sensor]:g}"
        errors.append(InputError(file.place(there[row]), found, "1 in contact, 0 without"))
    rows, faults = _match_rows(files, file, there, part)
    return rows, values == 1, errors + faults


def _touch(
    part: columns.ContactColumns, rows: np.ndarray, touching: np.ndarray, count: int
) -> dict[str, Any]:
    """Contacts [M, W] at M of so many rows, and none at the others, as arguments of `InMemorySource`; the
    sensors that make them."""
    contact = np.zeros((count, len(part.directions)), bool)
    contact[rows] = touching
    angle = np.radians(list(part.directions.values()))
    tips = part.distance * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    mounts = tuple((0.0, 0.0, direction) for direction in part.directions.values())
    sensors = PlanarWhiskersInfo(mounts=mounts, length=part.distance)
    point, alive = tips * contact[:, :, None], np.ones(len(angle), bool)
    return {"contact": contact, "point": point, "alive": alive, "sensors": sensors}


def _labels(files: _Files, labels: columns.LabelColumns) -> AlignedRows:
    """Place labels [M] int32 as given."""
    file = files.of(labels.file)
    ids, fault = file.column(labels.column), file.fault[:, file.at(labels.column)]
    there = np.flatnonzero((fault != EMPTY) & (ids != -1))
    ids = ids[there]
    rows, errors = _match_rows(files, file, there, labels)
    bad = ~((ids >= 0) & (ids <= np.iinfo(np.int32).max) & (ids == np.round(ids)))
    found, place = (lambda row: f"{labels.column} is {ids[row]}"), file.rows(there).place
    errors = first_error(bad, place, found, "an integer from 0; -1 or an empty cell for none") + errors
    return rows, ids if errors else ids.astype(np.int32), errors


def _pairs(files: _Files, part: columns.PairColumns) -> AlignedRows:
    """Place labels [V] int32 from pairs of times that a place recogniser matched, in order of appearance.

    Every time is a view; its best earlier match passes on its label, without one the view is a new place. Of
    matches with equal scores the first is used.
    """
    file = files.of(part.file)
    later, earlier = (file.column(name, "time") for name in (part.later, part.earlier))
    score = file.column(part.score)
    errors = file.judge([part.later, part.earlier, part.score])[1]
    crossed = later <= earlier
    found = lambda row: f"{part.later} {later[row]} is not after {part.earlier} {earlier[row]}"  # noqa: E731
    cure = "swap table.pairs.later and earlier" if crossed.mean() > 0.5 else ""
    errors += first_error(crossed, file.place, found, "the later time of a pair first", cure)
    if errors:
        return later, later, errors
    best: dict[float, tuple[float, float]] = {}
    for time, match, value in zip(later.tolist(), earlier.tolist(), score.tolist(), strict=True):
        if value >= part.threshold and (time not in best or value > best[time][0]):
            best[time] = value, match
    moments, ids, places = np.unique(np.concatenate([later, earlier])), dict[float, int](), 0
    for moment in moments.tolist():
        if moment in best:
            ids[moment] = ids[best[moment][1]]
        else:
            ids[moment], places = places, places + 1
    place = lambda row: f"{file.path}, time {moments[row]}"  # noqa: E731
    rows, errors = each_nearest(moments, files.time, part.tolerance, place)
    return rows, np.fromiter(ids.values(), np.int32, len(ids)), errors


def align_truth(
    file: CsvFile, part: columns.TruthColumns, time: np.ndarray, judge: InputJudge, same_rows: bool
) -> tuple[np.ndarray, list[InputError]]:
    """True poses [N, 3] at times [N] s, NaN outside the time span of the truth.

    Args:
        file: that of the truth. same_rows: its rows are those of `time`.
    """
    names = [name for name, _ in column_keys(part, "")[same_rows:]]
    clock = "" if same_rows else part.time
    good, errors = _sound_rows(file, names, "true poses", judge.warn, clock, part.quaternion or ())
    unknown = np.full((len(time), 3), np.nan)
    if errors:
        return unknown, errors
    file = file.rows(good)
    moments = time[good] if same_rows else file.column(part.time, "time", part.units.time)
    truth, errors = _read_poses(file, part, part.units, moments, judge.limits, "table.truth")
    if same_rows:
        unknown[good] = truth
        return unknown, errors
    errors += clock_errors(moments, part.time, file.place)
    if errors:
        return unknown, errors
    return alignment.interpolated_poses(time, moments, truth, part.time, str(file.path))


def column_keys(part: Settings, key: str) -> list[tuple[str, str]]:
    """The columns that a part of the table names, the time first, and their settings below `key`."""
    fields = part.model_dump(exclude={"prefix", "unit"})
    named = {field: name for field, name in fields.items() if isinstance(name, str)}
    if time := named.pop("time", None):
        named = {"time": time} | named
    for field in ("quaternion", "directions"):
        named |= {f"{field}.{place}": name for place, name in enumerate(fields.get(field) or ())}
    if fields.get("quaternion"):
        del named["heading"]  # which is not read
    return [(name, f"{key}.{field}") for field, name in named.items()]


def _read_poses(
    file: CsvFile,
    part: columns.PoseColumns,
    units: columns.TableUnits,
    time: np.ndarray,
    limits: UnitLimits,
    key: str,
) -> tuple[np.ndarray, list[InputError]]:
    """Poses [N, 3] (x m, y m, heading rad) of rows at times [N] s; `key`: their setting."""
    x, y = (file.column(name, "length", units.length) for name in (part.x, part.y))
    errors = []
    if plane := other_plane(file, part.x, part.y):
        still, z = plane
        lies = f"the path lies in {'xy'.replace(still, '')}-z"
        said = f"{lies}: {getattr(part, still)} hardly changes, {z} does"
        errors = [InputError(file.top, said, "columns of that plane", f"name {z} as {key}.{still}")]
    if part.quaternion is not None:
        return np.column_stack([x, y, _headings(file, part, part.quaternion)]), errors
    heading = file.column(part.heading, "angle", units.angle)
    cure = f"--set recording.{'table' if key == 'table.pose' else key}.units.angle=deg"
    if faults := heading_errors(heading, time, part.heading, str(file.path), limits, cure):
        errors += faults
        heading = np.deg2rad(heading)  # or every other check would report it again
    return np.column_stack([x, y, heading]), errors


def _headings(file: CsvFile, part: columns.PoseColumns, quaternion: Sequence[str]) -> np.ndarray:
    """Headings [N], rad, of an axis of the body in the plane of x and y, as `PoseColumns.quaternion` says."""
    values = np.column_stack([file.column(name) for name in quaternion])
    with np.errstate(all="ignore"):  # faulty rows are left out, or reported
        x, y, z, w = (values / np.linalg.norm(values, axis=1, keepdims=True)).T
    along = ["xyz".find(split_unit(name)[0][-1:].lower()) for name in (part.x, part.y)]
    ahead = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
    if 2 in along:
        ahead = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    first, second = along if min(along) >= 0 and along[0] != along[1] else (0, 1)
    return np.arctan2(ahead[second], ahead[first])


def other_plane(file: CsvFile, x: str, y: str) -> tuple[str, str] | None:
    """'x' or 'y' and the column z beside them, if a path hardly moves along that one but does along z."""
    name = file.names[file.at(y)]
    z = name[:-1] + {"y": "z", "Y": "Z"}.get(name[-1:], name[-1:])
    if z == name or z not in file.names:
        return None
    still = sanity_checks.still_axis(file.values[:, [file.at(name) for name in (x, y, z)]])
    return (still, z) if still else None


def _match_rows(
    files: _Files,
    file: CsvFile,
    there: np.ndarray,
    part: columns.ViewColumns | columns.ContactColumns | columns.LabelColumns,
) -> tuple[np.ndarray, list[InputError]]:
    """Odometry rows of the rows [M] of a file: the same, or the nearest in time."""
    if file is files.base:
        return there, []
    file = file.rows(there)
    moments = file.column(part.time, "time")
    errors = file.judge([part.time])[1]
    errors = errors or _clock_errors(file, part.time, moments, "write them with more digits")
    return (there, errors) if errors else each_nearest(moments, files.time, part.tolerance, file.place)


def each_nearest(
    moments: np.ndarray, time: np.ndarray, tolerance: float | None, place: RowName
) -> tuple[np.ndarray, list[InputError]]:
    """The odometry row nearest in time to each of the times [M], at most the tolerance away; each once.

    Args:
        moments: [M] s, increasing. time: [N] s, of the odometry rows. tolerance: s; None: the median step.
        place: names a row of `moments` in errors.
    """
    if not (np.diff(time) > 0).all():
        return np.zeros(len(moments), int), []  # the error of the clock is already reported
    rows, away, reach = alignment.nearest_rows(moments, time, tolerance)
    far, cure = away > reach, "raise tolerance, or bring both to one clock"
    one = f"(one of {int(far.sum())} such rows)"
    found_far = lambda i: f"the nearest odometry row is {away[i]:.4g} s away {one}"  # noqa: E731
    errors = first_error(far, place, found_far, f"at most {reach:.4g} s", cure)
    twice = np.append(False, np.diff(rows) == 0)
    text = f"belongs to the same odometry row as the previous one (one of {int(twice.sum())} such rows)"
    errors = errors or first_error(twice, place, lambda _: text, "one for each odometry row", "thin them out")
    return rows, errors
