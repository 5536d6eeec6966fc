"""Views and truth of any file or topic, assigned to the rows of the odometry, and the source that results."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import prod

import numpy as np

from robot.recordings.input_judge import Cures, InputJudge, MotionTrack, unit_cure
from robot.recordings.sanity_checks import RowName, first_error
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import raise_errors
from robot.sources.source import PlanarWhiskersInfo, SourceInfo
from tactile.base.bounded import MOST_PIXELS
from tactile.base.errors import InputError


@dataclass(eq=False)
class RecordingRows:
    """Rows of a recording while it is put together; N rows of odometry.

    Attributes:
        where: names the recording. time: [N] s. motion: [N, 4] (dx m, dy m, dtheta rad, dt s) since the
            previous row.
        shape: (R, C, 1) of every view. whiskers: W touch sensors, 0 for cameras and lasers.
        errors: found so far. held: whether the odometry was recorded as velocities. poses: [N, 3] as
            recorded, where poses were. place: names a row; None: by its number. cures: of wrong units.
        views, seen, label, truth, contact, point: as in `InMemorySource`. sensors: the whiskers that make
            contacts, if any.
    """

    where: str
    time: np.ndarray
    motion: np.ndarray
    shape: tuple[int, int, int]
    whiskers: int = 0
    errors: list[InputError] = field(default_factory=list)
    held: bool = False
    poses: np.ndarray | None = None
    place: RowName | None = None
    cures: Cures = unit_cure
    truth: np.ndarray | None = None
    contact: np.ndarray | None = None
    point: np.ndarray | None = None
    sensors: PlanarWhiskersInfo | None = None
    views: np.ndarray = field(init=False)
    seen: np.ndarray = field(init=False)
    label: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rows, pixels = len(self.time), prod(self.shape)
        if rows * pixels > MOST_PIXELS:
            found = f"{rows} views of {pixels} pixels"
            raise InputError(
                self.where, found, f"at most {MOST_PIXELS} pixels in all", "lower rows or columns"
            )
        self.views, self.seen = np.zeros((rows, *self.shape)), np.zeros(rows, bool)
        self.label = np.full(rows, -1, np.int32)

    def set_contacts(self, rows: np.ndarray, touching: np.ndarray, sensors: PlanarWhiskersInfo) -> None:
        """Contacts [M, W] bool of the tips of whiskers at M rows, and none at the others."""
        self.sensors, self.whiskers = sensors, len(sensors.mounts)
        self.contact = np.zeros((len(self.time), self.whiskers), bool)
        self.contact[rows] = touching
        base, angle = np.array(sensors.mounts)[:, :2], np.radians(np.array(sensors.mounts)[:, 2])
        tips = base + sensors.length * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.point = tips * self.contact[:, :, None]

    def source(self, name: str, digest: str, judge: InputJudge) -> InMemorySource:
        """The recording as a `Source`, after it was judged.

        Raises:
            InputError: rows have errors, or the odometry cannot be believed.
        """
        everywhere = np.ones(len(self.time), bool)
        track = MotionTrack(self.time, everywhere, self.motion, self.truth, self.held, self.poses)
        place = self.place or (lambda row: f"{self.where}, row {row}")
        judged = judge.errors(track, place, self.where, cures=self.cures, in_order=not self.errors)
        raise_errors(self.errors + judged)
        return InMemorySource(
            name=name,
            digest=judge.stretch.digest(digest),
            time=self.time,
            motion=self.motion,
            moved=everywhere,
            views=self.views,
            seen=self.seen,
            label=self.label,
            truth=self.truth,
            info=SourceInfo(
                labels_only=bool((self.label >= 0).any()) and not self.seen.any(),
                planar_whiskers=self.sensors,
            ),
            alive=np.ones(self.whiskers, bool),
            contact=self.contact,
            point=self.point,
        )


def range_pixels(
    ranges: np.ndarray, pixels: int, max_range: float, measured: np.ndarray | None = None
) -> np.ndarray:
    """Pixels [M, P] of laser ranges [M, B] m, B a multiple of P: mean of min(range, max_range) / max_range
    over equal groups of consecutive beams.

    Args:
        measured: [M, B] bool, the beams that count (default: all); a group without any is 1: nothing is seen.
    """
    measured = np.ones(ranges.shape, bool) if measured is None else measured
    near = np.where(measured, np.minimum(ranges, max_range), 0.0).reshape(len(ranges), pixels, -1)
    count = measured.reshape(near.shape).sum(axis=2)
    mean = near.sum(axis=2) / np.maximum(count, 1)
    return np.where(count > 0, mean, max_range) / max_range


def range_errors(
    lowest: np.ndarray, typical: float, max_range: float, what: str, place: RowName, where: str, key: str
) -> list[InputError]:
    """Errors of ranges that cannot be in metres.

    Args:
        lowest: [M] smallest range of each view, m. typical: median of all. key: setting of `max_range`.
    """
    errors = first_error(lowest < 0, place, lambda row: f"{what} is {lowest[row]}", "ranges of 0 m or more")
    if typical > 20 * max_range:  # half of them would be out of range by far: another unit
        unit = "--set recording.table.views.unit=mm" if key.startswith("table") else "divide by 1000"
        cure = f"{unit} if they are millimetres, else raise {key}"
        errors.append(InputError(where, f"half of the ranges are over {typical:.4g} m", "metres", cure))
    return errors


def nearest_rows(
    moments: np.ndarray, time: np.ndarray, tolerance: float | None
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """The odometry row nearest in time to each of the times [M] s.

    Args:
        time: [N] s of the odometry. tolerance: how far a value may be away, s; None: the median step.

    Returns:
        The rows [M], how far they are away [M] s, and how far they may be, s;
        None if the odometry's times do not increase, which is an error of its own.
    """
    steps = np.diff(time)
    if not (steps > 0).all():
        return None
    rows = np.searchsorted(time[:-1] + steps / 2, moments)
    reach = float(np.median(steps)) if tolerance is None and len(steps) else tolerance or 0.0
    return rows, np.abs(time[rows] - moments), reach


def interpolated_poses(
    time: np.ndarray, moments: np.ndarray, poses: np.ndarray, what: str, where: str
) -> tuple[np.ndarray, list[InputError]]:
    """Poses [N, 3] at the times [N] s, NaN outside the time span of the given ones.

    Args:
        moments: [M] s, increasing. poses: [M, 3] (x m, y m, heading rad), wrapped or not.
        what: name of the moments, for errors.
    """
    columns = [poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2])]
    known = (moments[0] <= time) & (time <= moments[-1])
    errors = []
    if not known.any():
        errors.append(no_overlap_error(moments, time, what, where))
    at = np.column_stack([np.interp(time, moments, column) for column in columns])
    return np.where(known[:, None], at, np.nan), errors


def no_overlap_error(moments: np.ndarray, time: np.ndarray, what: str, where: str) -> InputError:
    """The error for times [M] s that have none of the odometry's [N] s among them."""
    found = f"{what} is {moments[0]} to {moments[-1]} s, the odometry's {time[0]} to {time[-1]}"
    return InputError(where, found, "times that overlap", "bring both to one clock")
