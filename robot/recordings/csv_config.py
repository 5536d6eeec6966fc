"""Which column of which CSV file means what."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from tactile.base.config import Settings


class PoseColumns(Settings):
    """Odometry as poses of a world frame; their differences are the motion, the sideways part kept."""

    x: str = "x"
    """Column of the position, m."""
    y: str = "y"
    """Column of the position, m."""
    heading: str = "heading"
    """Column of the heading, rad, counter-clockwise; wrapped or not."""


class VelocityColumns(Settings):
    """Odometry as body velocities over the interval since the row before, along the heading halfway."""

    forward: str = "vx"
    """Column of the forward speed, m/s."""
    left: str | None = None
    """Column of the speed to the left, m/s; none for a robot that cannot slide."""
    turn: str = "w"
    """Column of the turn rate, rad/s, counter-clockwise."""


class ViewColumns(Settings):
    """Views of rows x columns pixels from numbered columns (r0, r1, ...)."""

    file: Path | None = None
    """Their file; a `*` in its name stands for the beginning of the recording's file name. Null: they stand
    beside the odometry, with empty cells in rows without a view."""
    time: str = "t"
    """Column of the time, s, in that file."""
    prefix: str = "r"
    """The columns' name before the number."""
    max_range: float | None = Field(default=None, gt=0)
    """Laser ranges, m: each pixel is the mean of min(range, max_range) / max_range over an equal share
    of consecutive beams, so beams must be a multiple of the pixels. None: pixel values in 0..1."""
    tolerance: float | None = Field(default=None, ge=0)
    """A view belongs to the nearest odometry row, at most so far away, s; none: a median step."""


class LabelColumns(Settings):
    """Place ids that somebody gives with the recording."""

    file: Path | None = None
    """Their file; none if they stand beside the odometry."""
    time: str = "t"
    """Column of the time, s, in that file."""
    column: str = "label"
    """Column of the ids, whole numbers from 0; empty or -1 for none."""
    tolerance: float | None = Field(default=None, ge=0)
    """As for views."""


class PairColumns(Settings):
    """Pairs of times found alike: the best earlier match with at least the threshold passes on its id,
    else the view is a new place."""

    file: Path
    """The file of pairs; every time in it is a view."""
    later: str = "t1"
    """Column of the later view's time, s."""
    earlier: str = "t2"
    """Column of the earlier view's time, s."""
    score: str = "score"
    """Column that says how alike they are."""
    threshold: float = 0.75
    """The least score of a match."""
    tolerance: float | None = Field(default=None, ge=0)
    """As for views."""


class TruthColumns(Settings):
    """Where the robot really was, interpolated to the odometry rows; none outside the time it spans."""

    file: Path | None = None
    """Its file; none if it stands beside the odometry."""
    time: str = "t"
    """Column of the time, s, in that file."""
    x: str = "x"
    """Column of the position, m."""
    y: str = "y"
    """Column of the position, m."""
    heading: str = "heading"
    """Column of the heading, rad; wrapped or not."""


class CsvConfig(Settings):
    """Which column means what."""

    time: str = "t"
    """Column of the time, s."""
    pose: PoseColumns | None = None
    """Odometry as poses; give either these or velocities."""
    velocity: VelocityColumns | None = None
    """Odometry as velocities."""
    rows: int = Field(default=3, gt=0)
    """R, rows of a view; of the masked view, too, where there are only labels."""
    columns: int = Field(default=6, gt=0)
    """C, columns of a view."""
    views: ViewColumns | None = None
    """Views, if there are any."""
    labels: LabelColumns | None = None
    """Place ids, if they are given."""
    pairs: PairColumns | None = None
    """Pairs of views found alike, to make place ids of."""
    truth: TruthColumns | None = None
    """The true path, if it is known."""
