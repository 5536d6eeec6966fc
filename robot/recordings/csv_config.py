"""Settings that assign columns of CSV files, and units in their headers: `t [ms]`, `heading_deg`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat

from tactile.base.settings import Settings, Side
from tactile.whisker_geometry import Degrees

_TimeUnit = Literal["s", "ms", "us", "ns", "ks", "min"]
_LengthUnit = Literal["m", "mm", "cm", "km"]
_AngleUnit = Literal["rad", "deg"]
PER_UNIT: dict[str, dict[str, float]] = {
    "time": {"s": 1, "ms": 1e3, "us": 1e6, "ns": 1e9, "min": 1 / 60, "ks": 1e-3},
    "length": {"m": 1, "mm": 1e3, "cm": 1e2, "km": 1e-3},
    "angle": {"rad": 1, "deg": 57.29577951308232},
}
"""For each quantity, how many of a unit are one s, m or rad."""
WORDS = {
    **{"s": "seconds second secs sec", "ms": "milliseconds millis msec", "us": "microseconds micros usec"},
    **{"ns": "nanoseconds nanosec nsec", "min": "minutes", "ks": "kiloseconds"},
    **{"m": "metres meters metre meter", "mm": "millimetres millimeters", "cm": "centimetres centimeters"},
    **{"km": "kilometres kilometers", "rad": "radians radian rads", "deg": "degrees degree degs"},
    **{"m/s": "mps", "deg/s": "dps", "": "- 1"},
}
"""Other spellings of each unit, its name first."""
_ALIASES = {word: unit for unit, words in WORDS.items() for word in words.split()}
_BRACKETS = re.compile(r"(.+?)\s*(?:\[([^\[\]]*)\]|\(([^()]*)\))")


def _plain_unit(text: str) -> str:
    """A unit in one spelling: `deg/s` for `°/sec`, `m/s` for `m s^-1`; unknown ones remain."""
    text = text.strip().lower().replace("µ", "u").replace("μ", "u").replace("°", "deg")
    text = re.sub(r"[\s*·.]+([a-z]+)\^?-1$|[\s_]*(?:/|_per_| per |_)\s*([a-z]+)$", r"/\1\2", text)
    text = "/".join(_ALIASES.get(word.strip(), word.strip()) for word in text.split("/"))
    return _ALIASES.get(text, text)


def per_unit(unit: str, quantity: str) -> float | None:
    """How many of a unit are one in s, m and rad, for a quantity such as `length` or `angle/time`; None if it
    is no unit of it."""
    units, quantities = unit.split("/"), quantity.split("/")
    factors = [PER_UNIT[name].get(part, 0.0) for name, part in zip(quantities, units, strict=False)]
    if len(units) != len(quantities) or not all(factors):
        return None
    return factors[0] if len(factors) == 1 else factors[0] / factors[1]


def split_unit(name: str) -> tuple[str, str]:
    """The name of a column without its unit, and the unit, '' without one; `[...]` always holds a unit unless
    it is a number: `ranges[0]` is `ranges0`."""

    def is_unit(unit: str) -> bool:
        return any(per_unit(unit, kind + rate) is not None for kind in PER_UNIT for rate in ("", "/time"))

    if found := _BRACKETS.fullmatch(name):
        before, square, round_ = found.groups()
        if square is not None and square.isdecimal():
            return before + square, ""
        unit = _plain_unit(square or round_ or "")
        if square is not None or is_unit(unit):
            return split_unit(before)[0] if before.endswith("]") else before, unit
    words = name.split("_")
    for count in (3, 2, 1):
        unit = _plain_unit("_".join(words[-count:]))
        if len(words) > count and is_unit(unit) and unit not in ("min", ""):  # `laser_min` has none
            return "_".join(words[:-count]), unit
    return name, ""


Quaternion = Annotated[list[str], Field(min_length=4, max_length=4)]


class TableUnits(Settings):
    """Units of columns; null: that of the header (`t [ms]`, `x_mm`), else s, m, rad."""

    time: _TimeUnit | None = None
    """Of times. Speeds and turn rates are per second whatever it is, unless the header says otherwise."""
    length: _LengthUnit | None = None
    """Of positions, distances, and speeds (per second)."""
    angle: _AngleUnit | None = None
    """Of headings, turns, and turn rates (per second)."""


class PoseColumns(Settings):
    """Odometry as poses in a world frame; motion is their difference, including sideways motion."""

    x: str = "x"
    """Column of the position, m."""
    y: str = "y"
    """Column of the position, m."""
    heading: str = "heading"
    """Column of the heading, rad, counter-clockwise; wrapped or not."""
    quaternion: Quaternion | None = None
    """Columns x, y, z, w of a quaternion, read instead of `heading`: where the body's x axis points, or in a
    plane with the column z, as of a camera, its z axis."""


class VelocityColumns(Settings):
    """Odometry as body velocities since the previous row, along the heading half-way through the turn."""

    forward: str = "vx"
    """Column of the forward speed, m/s."""
    left: str | None = None
    """Column of the speed to the left, m/s; null for a robot that cannot move sideways."""
    turn: str = "w"
    """Column of the turn rate, rad/s, counter-clockwise."""


class MotionColumns(Settings):
    """Odometry as motions since the previous row, along the heading half-way through the turn."""

    forward: str = "distance"
    """Column of the distance forwards, m."""
    left: str | None = None
    """Column of the distance to the left, m; null for a robot that cannot move sideways."""
    turn: str = "turn"
    """Column of the turn, rad, counter-clockwise."""


class _OtherFile(Settings):
    """Columns that may stand in another file."""

    file: Path | None = None
    """File of these columns; a `*` in its name stands for the beginning of the recording's file name. Null:
    the odometry file."""
    time: str = "t"
    """Column of the time, s, in that file."""


class ViewColumns(_OtherFile):
    """Views of rows x columns pixels from numbered columns (r0, r1, ...); in the odometry file with empty
    cells in rows without a view."""

    prefix: str = "r"
    """Name of the columns before the number."""
    max_range: float | None = Field(default=None, gt=0)
    """Laser ranges, m: each pixel is the mean of min(range, max_range) / max_range over an equal share
    of consecutive beams, so their number must be a multiple of the pixels. Null: pixel values in 0..1."""
    tolerance: float | None = Field(default=None, ge=0)
    """Largest time between a view and its nearest odometry row, s; null: the median step."""
    unit: _LengthUnit | None = None
    """Unit of the ranges; null: that of the header, else m."""


class ContactColumns(_OtherFile):
    """Contacts of touch sensors around the robot, such as bumpers: a column each, 1 in contact, else 0."""

    directions: Annotated[dict[str, Degrees], Field(min_length=1)] = Field(
        default={"left": 45.0, "front": 0.0, "right": -45.0}
    )
    """For each column the direction of what its sensor touches, degrees counter-clockwise from ahead."""
    distance: PositiveFloat = 0.17
    """Distance of what is touched from the origin of base_link, m: the radius of a round robot."""
    tolerance: float | None = Field(default=None, ge=0)
    """As for views."""


class LabelColumns(_OtherFile):
    """Place labels given with the recording."""

    column: str = "label"
    """Column of the labels, integers from 0; empty or -1 for none."""
    tolerance: float | None = Field(default=None, ge=0)
    """As for views."""


class PairColumns(Settings):
    """Pairs of times matched by a place recogniser: the best earlier match above the threshold passes on its
    label; without one the view is a new place."""

    file: Path
    """File of the pairs; every time in it is a view."""
    later: str = "t1"
    """Column of the later view's time, s."""
    earlier: str = "t2"
    """Column of the earlier view's time, s."""
    score: str = "score"
    """Column of the match score."""
    threshold: float = 0.75
    """Smallest score of a match."""
    tolerance: float | None = Field(default=None, ge=0)
    """As for views."""


class TruthColumns(_OtherFile, PoseColumns):
    """True poses, interpolated to the odometry rows; none outside their time span."""

    units: TableUnits = TableUnits()
    """Units of the true poses, and of the time in their file."""


class CsvConfig(Settings):
    """Columns of a CSV recording."""

    time: str = "t"
    """Column of the time, s, or a date with a time of day (2024-05-01T10:00:00.123Z; UTC without a zone)."""
    rate: PositiveFloat | None = None
    """Rows per second, counted from the first time: for times that are rounded so that rows share them."""
    units: TableUnits = TableUnits()
    """Units of the odometry, and of times in other files whose header states none."""
    pose: PoseColumns | None = None
    """Odometry as poses; give one of poses, velocities and motions."""
    velocity: VelocityColumns | None = None
    """Odometry as velocities."""
    motion: MotionColumns | None = None
    """Odometry as motions."""
    rows: Side = 3
    """R, rows of a view, also of the masked view of a recording with labels only."""
    columns: Side = 6
    """C, columns of a view."""
    views: ViewColumns | None = None
    """Views, if any."""
    contacts: ContactColumns | None = None
    """Contacts, if any."""
    labels: LabelColumns | None = None
    """Place labels, if any."""
    pairs: PairColumns | None = None
    """Matched pairs of views, from which place labels follow."""
    truth: TruthColumns | None = None
    """True poses, if known."""
