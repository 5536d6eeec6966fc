"""Views and truth of any file or topic, assigned to the rows of the odometry, and the source that results."""

from __future__ import annotations

from dataclasses import replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from robot.recordings.input_judge import Cures, InputJudge, MotionTrack
from robot.recordings.sanity_checks import RowName, first_error
from robot.sources.in_memory import InMemorySource
from robot.sources.input_files import raise_errors
from tactile.base.bounded import MOST_PIXELS
from tactile.base.errors import InputError


def blank_rows(
    path: Path, time: np.ndarray, motion: np.ndarray, shape: tuple[int, int, int]
) -> dict[str, Any]:
    """The arguments of an `InMemorySource` with odometry [N, 4] at times [N] s, and nothing else.

    Raises:
        InputError: these are too many pixels.
    """
    rows = len(time)
    if rows * prod(shape) > MOST_PIXELS:
        found = f"{rows} views of {prod(shape)} pixels"
        raise InputError(str(path), found, f"at most {MOST_PIXELS} pixels in all", "lower rows or columns")
    blank = {"views": np.zeros((rows, *shape)), "seen": np.zeros(rows, bool), "moved": np.ones(rows, bool)}
    blank |= {"label": np.full(rows, -1, np.int32), "time": time, "motion": motion}
    return {"name": path.stem, "truth": None, **blank}


def judged(
    source: InMemorySource,
    errors: list[InputError],
    judge: InputJudge,
    where: str,
    place: RowName | None = None,
    held: bool = False,
    poses: np.ndarray | None = None,
    cures: Cures | None = None,
) -> InMemorySource:
    """A recording after it was judged; its digest is that of the stretch that was read.

    Args:
        errors: found so far. place, cures: as for `InputJudge.errors`; rows are named by their number by
            default. held, poses: as in `MotionTrack`.

    Raises:
        InputError: rows have errors, or the odometry cannot be believed.
    """
    track = MotionTrack(source.time, source.moved, source.motion, source.truth, held, poses)
    place = place or (lambda row: f"{where}, row {row}")
    raise_errors([*errors, *judge.errors(track, place, where, cures=cures, in_order=not errors)])
    return replace(source, digest=judge.stretch.digest(source.digest))


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
) -> tuple[np.ndarray, np.ndarray, float]:
    """The odometry row nearest in time to each of the times [M] s.

    Args:
        time: [N] s of the odometry, increasing. tolerance: how far a value may be away, s; None: the median
            step.

    Returns:
        The rows [M], how far they are away [M] s, and how far they may be, s.
    """
    steps = np.diff(time)
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
    errors = [] if known.any() else [no_overlap_error(moments, time, what, where)]
    at = np.column_stack([np.interp(time, moments, column) for column in columns])
    return np.where(known[:, None], at, np.nan), errors


def no_overlap_error(moments: np.ndarray, time: np.ndarray, what: str, where: str) -> InputError:
    """The error for times [M] s that have none of the odometry's [N] s among them."""
    found = f"{what} is {moments[0]} to {moments[-1]} s, the odometry's {time[0]} to {time[-1]}"
    return InputError(where, found, "times that overlap", "bring both to one clock")
