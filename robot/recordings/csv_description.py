"""What a CSV file of a robot holds, guessed from its columns, and the settings of `table` that read it."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robot.recordings.csv_config import PER_UNIT
from robot.recordings.csv_file import CsvFile, read_csv
from robot.recordings.csv_reader import other_plane, rounded_rate
from tactile.base.errors import InputError

TIMES = ("t", "time", "timestamp", "stamp", "secs", "seconds", "sec", "header_stamp", "datetime")
_FORWARD_SPEEDS = ("vx", "v", "v_x", "speed", "linear_x", "linear", "forward_speed")
_LEFT_SPEEDS = ("vy", "v_y", "linear_y")
_TURN_RATES = ("w", "wz", "w_z", "omega", "yaw_rate", "turn_rate", "angular_z", "angular", "gyro_z", "gyro")
DISTANCES = ("distance", "dist", "ds", "forward")
TURNS = ("turn", "dtheta", "dth", "rotation")
HEADINGS = ("heading", "theta", "th", "yaw")
LABELS = ("label", "place", "place_id")
"""Names of columns, in lower case; those with `_` may also be the end of a name, as in rostopic's."""
PLACE = re.compile(r"(^|_)(p|t|pos|position|pose|translation|location)_?$")
_QUATERNION = re.compile(r"(^|_)(q|quat|orient|rot)")
MOVING = re.compile(r"(^|_)(v|w|a|b|vel|acc|lin|ang|gyro|imu|twist)")
"""Names before x, y, z and w: of positions, of quaternions, and of what is neither."""
NO_VIEWS = re.compile(r"covariance|intensit", re.IGNORECASE)
EPOCH = 1e9, 4e9
"""Times of day of 2001 to 2096 in s, which tells the unit of such times."""
TRUE = re.compile(r"gt|true|truth|ground|mocap|vicon|reference")
"""Names of columns and files with true poses."""
_FEWEST_PIXELS = 4
"""Least number of numbered columns that make a view."""
COLUMNS = (18, 36, 24, 20, 30, 16, 12, 32, 15, 10, 9, 8, 6)
"""Columns of a view of ranges, the first that divides their number."""


class CsvDescription(NamedTuple):
    """A file and its _companions.

    Attributes:
        rows: number of lines with values. time: [N] s, finite; None without a column of times.
        columns: name, least and greatest value of all, but numbered ones are joined: `r0 .. r179`.
        parts: what was found for each setting.
        table: the settings that read it, {} if it has no time or no odometry.
        max_range: of the views, m; NaN without ranges. missing: what it lacks, in words.
    """

    rows: int
    time: np.ndarray | None
    columns: tuple[tuple[str, float, float], ...]
    parts: dict[str, str]
    table: dict[str, Any]
    max_range: float
    missing: tuple[str, ...]


def describe_csv(path: Path) -> CsvDescription:
    """Reads a file and the files beside it whose names begin alike.

    Raises:
        InputError: it is not a CSV file of numbers.
    """
    file = read_csv(path)
    time = _named(file, TIMES)
    parts, table, missing = dict[str, str](), dict[str, Any](), list[str]()
    if time is None or not np.isfinite(file.column(time)).any():
        faults = file.judge([time])[1] if time is not None else []
        missing.append(str(faults[0]) if faults else "a column of times (t, time, stamp)")
        return CsvDescription(len(file.values), None, _columns(file), {}, {}, np.nan, tuple(missing))
    odometry = _odometry(file)
    units = _units(file, time, odometry or {})
    file = replace(file, clock=units.get("time"))
    files = [file, *_companions(file, time)]
    if odometry is None:
        missing.append("odometry: columns x, y, heading, or v, w, or distance, turn")
    else:
        table = {"time": time} | ({"units": units} if units else {}) | odometry
        parts["odometry"] = _words(odometry)
        parts |= {kind: f"unit of {kind}: {unit}" for kind, unit in units.items()}
        pose = odometry.get("pose", {})
        if (pose and pose["y"][-1:].lower() == "z") or pose.get("x", "")[-1:].lower() == "z":
            parts["plane"] = f"the path lies in the plane of {pose['x']} and {pose['y']}"
    max_range = np.nan
    for other in files:
        views, ranges = _views(file, other)
        if views is not None and "views" not in table:
            table |= views
            max_range = ranges
        table |= {name: part for name, part in _truth_and_labels(file, other).items() if name not in table}
    if "pairs" in table and "labels" in table:
        del table["pairs"]
    beside = ("views", "truth", "labels", "pairs")
    parts |= {name: _words({name: part}) for name, part in table.items() if name in beside}
    if not {"views", "labels", "pairs"} & table.keys():
        missing.append("views: numbered columns (r0, r1, ...), here or in a file whose name begins alike")
    if "truth" not in table:
        missing.append("true poses (a run then has no score, but a health)")
    moments = file.column(time, "time")
    if table and (rate := rounded_rate(moments, file.values)) is not None:
        table["rate"] = float(f"{rate:.6g}")
        parts["rate"] = f"rounded times: rows share each, so they are counted instead, {rate:.6g} a second"
        moments = moments[0] + np.arange(len(moments)) / rate
    moments, found = moments[np.isfinite(moments)], table if odometry else {}
    columns = _columns(file)
    return CsvDescription(len(file.values), moments, columns, parts, found, max_range, tuple(missing))


def _companions(file: CsvFile, time: str) -> list[CsvFile]:
    """CSV files beside it whose names share its first word, with times that overlap."""
    word = re.split(r"[_\-. ]", file.path.stem)[0]
    own = file.column(time, "time")
    first, last = np.nanmin(own), np.nanmax(own)
    found = []
    for path in sorted(file.path.parent.glob(f"{word}*.csv")):
        if path == file.path:
            continue
        try:
            other = read_csv(path, file.clock)
        except InputError:
            continue
        column = _named(other, TIMES) or (other.names[0] if "t2" in other.names else None)
        times = other.column(column, "time") if column else np.zeros(0)
        times = times[np.isfinite(times)]
        if len(times) and times.min() <= last and times.max() >= first:
            found.append(other)
    return found


def _named(file: CsvFile, names: Sequence[str]) -> str | None:
    """The column with one of these names, in any case and with any signs between words."""
    lower = _lower(file)
    ends = (lower[long] for name in names if "_" in name for long in lower if long.endswith(f"_{name}"))
    return next((lower[name] for name in names if name in lower), next(ends, None))


def _lower(file: CsvFile) -> dict[str, str]:
    """The names by their lower case with `_` for other signs: `pose.position.x` by `pose_position_x`."""
    found = dict[str, str]()
    for name in file.names:
        found.setdefault(re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_"), name)
    return found


def _units(file: CsvFile, time: str, odometry: dict[str, Any]) -> dict[str, str]:
    """Units other than s, m, rad that the header states, the same for all columns, or that dates tell."""
    part: dict[str, Any] = next(iter(odometry.values()), {})
    columns = {
        "time": [time],
        "length": [part[key] for key in ("x", "y", "forward", "left") if key in part],
        "angle": [part[key] for key in ("heading", "turn") if key in part],
    }
    units = {}
    for kind, names in columns.items():
        stated = {file.units[file.at(name)].removesuffix("/s") for name in names}
        unit = next(iter(stated)) if len(stated) == 1 else ""
        if kind == "time" and not unit and file.at(time) not in file.dates:
            first = float(np.nanmin(file.column(time)))
            scales = PER_UNIT[kind].items()
            unit = next((unit for unit, factor in scales if EPOCH[0] <= first / factor < EPOCH[1]), "")
        if PER_UNIT[kind].get(unit, 1) != 1:
            units[kind] = unit
    return units


def _poses(file: CsvFile) -> dict[str, dict[str, Any]]:
    """Columns x, y, and heading or quaternion, by the common prefix of x and y."""
    lower, found = _lower(file), dict[str, dict[str, Any]]()
    stems = [name[:-1] for name in lower if name.endswith("w") and _QUATERNION.search(name[:-1])]
    stems = [stem for stem in stems if all(stem + axis in lower for axis in "xyz")]
    turns = {stem: [lower[stem + axis] for axis in "xyzw"] for stem in stems}
    for name in lower:
        prefix, end = name[:-1], name[-1:]
        if end != "x" or f"{prefix}y" not in lower:
            continue
        heading = next((prefix + word for word in HEADINGS if prefix + word in lower), None)
        true, known = bool(TRUE.search(prefix)), prefix not in turns and not MOVING.search(prefix)
        if heading is None and known and not true and PLACE.search(prefix):
            heading = next((word for word in HEADINGS if word in lower), None)
        columns: dict[str, Any] = {"x": lower[name], "y": lower[f"{prefix}y"]}
        like = [stem for stem in turns if bool(TRUE.search(stem)) == true]
        if heading is not None:
            columns["heading"] = lower[heading]
        elif known and like:
            closest = max(like, key=lambda stem: sum(map(str.__eq__, stem, prefix)))
            columns["quaternion"] = turns[closest]
        else:
            continue
        if plane := other_plane(file, columns["x"], columns["y"]):
            columns[plane[0]] = plane[1]
        found[prefix] = columns
    return found


def _odometry(file: CsvFile) -> dict[str, Any] | None:
    only_true = bool(TRUE.search(file.path.stem))
    poses = {prefix: columns for prefix, columns in _poses(file).items() if not TRUE.search(prefix)}
    if only_true:
        poses.pop("", None)
    if poses:
        return {"pose": next(iter(poses.values()))}
    steps = {"velocity": (_FORWARD_SPEEDS, _TURN_RATES, _LEFT_SPEEDS), "motion": (DISTANCES, TURNS, ())}
    for kind, names in steps.items():
        forward, turn, left = (_named(file, each) for each in names)
        if forward is not None and turn is not None:
            return {kind: {"forward": forward, "turn": turn} | ({"left": left} if left else {})}
    return None


def _truth_and_labels(file: CsvFile, other: CsvFile) -> dict[str, dict[str, Any]]:
    """The settings of true poses and of place labels from the other file, as far as it has them."""
    found, poses = dict[str, dict[str, Any]](), _poses(other)
    if other is file or not TRUE.search(other.path.stem):
        poses = {prefix: columns for prefix, columns in poses.items() if TRUE.search(prefix)}
    if columns := next(iter(poses.values()), None):
        found["truth"] = _file(file, other) | columns
    if label := _named(other, LABELS):
        found["labels"] = _file(file, other) | {"column": label}
    if other is not file and {"t1", "t2", "score"} <= set(other.names):
        found["pairs"] = {"file": str(other.path)}
    return found


def _views(file: CsvFile, other: CsvFile) -> tuple[dict[str, Any] | None, float]:
    """The settings of views from this file, and their largest range, NaN without ranges."""
    found = [("range" in stem.lower(), count, stem) for stem, count in _stems(other).items()]
    _, count, prefix = max((entry for entry in found if not NO_VIEWS.search(entry[2])), default=(0, 0, ""))
    if count < _FEWEST_PIXELS:
        return None, np.nan
    values = other.block(prefix)[0]
    known = values[np.isfinite(values) & (values > 0)]
    columns = next((columns for columns in COLUMNS if count % columns == 0), count)
    shape = {"rows": 3, "columns": 6} if columns == 18 else {"rows": 1, "columns": columns}
    views = _file(file, other) | {"prefix": prefix}
    if not len(known) or known.max() <= 1.0:
        return {"rows": 1, "columns": count, "views": views}, np.nan
    reach = 1.25 * float(np.quantile(known, 0.9))  # of a view
    scale, steps = 10.0 ** np.floor(np.log10(reach)), np.array([1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10])
    reach = float(f"{scale * steps[np.argmin(np.abs(steps - reach / scale))]:.3g}")  # two digits at most
    return shape | {"views": views | {"max_range": reach}}, reach


def _stems(file: CsvFile) -> Counter[str]:
    """Names of numbered columns before their number, and how many there are of each."""
    return Counter(name.rstrip("0123456789") for name in file.names if name[-1:] in set("0123456789"))


def _file(file: CsvFile, other: CsvFile) -> dict[str, Any]:
    """The settings that name another file and its times."""
    if other is file:
        return {}
    time = _named(other, TIMES) or ""
    return {"file": str(other.path)} | ({"time": time} if time != "t" else {})


def _columns(file: CsvFile) -> tuple[tuple[str, float, float], ...]:
    found, stems = dict[str, np.ndarray](), _stems(file)
    for place, name in enumerate(file.names):
        prefix = name.rstrip("0123456789")
        if prefix != name and stems[prefix] >= _FEWEST_PIXELS:
            numbers = list(file.numbered(prefix))
            joined = f"{prefix}{numbers[0]} .. {prefix}{numbers[-1]}"
            if joined not in found:
                found[joined] = file.block(prefix)[0]
        else:
            found[name] = file.values[:, place]
    columns = []
    for name, values in found.items():
        known = values[np.isfinite(values)]
        low, high = (known.min(), known.max()) if len(known) else (np.nan, np.nan)
        columns.append((name, float(low), float(high)))
    return tuple(columns)


def _words(settings: dict[str, Any]) -> str:
    """Settings in one line: `pose: x, y, heading`."""
    lines = []
    for name, part in settings.items():
        words = {key: Path(value).name if key == "file" else str(value) for key, value in part.items()}
        words |= {key: f"{key} {words[key]}" for key in ("prefix", "max_range") if key in words}
        lines.append(f"{name}: {', '.join(words.values())}")
    return "; ".join(lines)
