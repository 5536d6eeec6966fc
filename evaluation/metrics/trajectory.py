"""Trajectory errors (alignment, ATE, RPE, online error), interpolation and TUM files.

A trajectory is an array [N, 3] of x (m), y (m), heading (rad). Functions that compare two expect rows of the
same times (`interpolate` makes them).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tactile.base.bounded import read_text_table
from tactile.base.errors import InputError
from tactile.base.se2 import between, compose, fit_rigid_motion, tum_line, wrap

_TUM = {name: () for name in ("t", "x", "y", "z", "qx", "qy", "qz", "qw")}


def align(estimate: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """The rigid motion [3] that brings the estimate's positions [N, 3] nearest to the reference's [N, 3].

    Least squares over rotation and translation, without scale; compose(align(e, r), e) is e aligned to r.

    Raises:
        InputError: no rows, or different numbers of rows.
    """
    _positions(estimate, reference)
    return fit_rigid_motion(estimate, reference)


def position_errors(estimate: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Distance [N] (m) of each row from the reference after one alignment over all rows."""
    aligned = compose(align(estimate, reference), estimate)
    return np.hypot(*(aligned - reference)[:, :2].T)


def position_error(path: np.ndarray, truth: np.ndarray) -> float:
    """Mean position error of poses [N, 3] without alignment, m."""
    return float(np.hypot(*(path - truth)[:, :2].T).mean())


def ate(estimate: np.ndarray, reference: np.ndarray) -> float:
    """Absolute trajectory error: root mean square of `position_errors`, m (Sturm et al. 2012)."""
    return _rms(position_errors(estimate, reference))


def successive_pairs(count: int, step: int = 1) -> np.ndarray:
    """The pairs (i, i + step) of `count` rows: [P, 2]."""
    i = np.arange(max(0, count - step))
    return np.stack([i, i + step], axis=1)


def motion_errors(estimate: np.ndarray, reference: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Error of the estimated motion between two rows, delta_ij (-) delta*_ij: [P, 3], m, m, rad.

    Args:
        pairs: [P, 2] row indices i, j.

    Source: Salman & Pearson 2016, eq. 1 and 2; Kuemmerle et al. 2009.
    """
    i, j = np.asarray(pairs, int).reshape(-1, 2).T
    return between(between(reference[i], reference[j]), between(estimate[i], estimate[j]))


def rpe(estimate: np.ndarray, reference: np.ndarray, step: int = 1) -> tuple[float, float]:
    """Relative pose error over `step` rows (Sturm et al. 2012): root mean squares of translation, m, and
    rotation, rad; NaN with fewer rows."""
    error = motion_errors(estimate, reference, successive_pairs(len(estimate), step))
    return _rms(np.hypot(error[:, 0], error[:, 1])), _rms(error[:, 2])


def online_errors(online: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Distance [N] (m) of each row from the reference after alignment of the rows up to it.

    The error at a time thus depends on earlier rows only. Running sums give all alignments in O(N).
    """
    a, b = _positions(online, reference)
    a, b = a - a.mean(), b - b.mean()  # keeps rounding errors of the running sums small
    n = np.arange(1, len(a) + 1)
    mean_a, mean_b = np.cumsum(a) / n, np.cumsum(b) / n
    turn = np.angle(np.cumsum(a.conj() * b) - n * mean_a.conj() * mean_b)
    return np.abs(np.exp(1j * turn) * (a - mean_a) - (b - mean_b))


def current_error(path: np.ndarray, reference: np.ndarray) -> float:
    """Distance (m) of the last row of a path [N, 3] from the reference after alignment of the whole path.

    With the path in the map of that time, it is the error of a robot that acts on its map.
    """
    return float(position_errors(path, reference)[-1])


def summarize_errors(error: np.ndarray) -> tuple[float, float, float]:
    """Of errors [N] in order of time their median, the root mean square over the second half of the rows, and
    the largest change from one row to the next."""
    jump = np.abs(np.diff(error)).max(initial=0.0)
    return float(np.median(error)), _rms(error[len(error) // 2 :]), float(jump)


def interpolate(time: np.ndarray, pose: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Poses [..., 3] at the times `at` [...], linear between rows; NaN before the first and after the last.

    The heading is interpolated along the shorter arc.

    Raises:
        InputError: time [N] does not increase.
    """
    if np.any(np.diff(time) <= 0):
        row = int(np.argmax(np.diff(time) <= 0))
        found = f"time {time[row + 1]} after {time[row]}"
        raise InputError(f"trajectory, row {row + 1}", found, "increasing times")
    columns = (pose[:, 0], pose[:, 1], np.unwrap(pose[:, 2]))
    x, y, heading = (np.interp(at, time, column, left=np.nan, right=np.nan) for column in columns)
    return np.stack([x, y, wrap(heading)], axis=-1)


def read_tum(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Time [N] s and planar pose [N, 3] of a TUM file, `t x y z qx qy qz qw` a line.

    z, roll and pitch are ignored. An incomplete last line is dropped.

    Raises:
        InputError: the file cannot be read or a line is malformed.
    """
    values, line = read_text_table(path, _TUM)
    t, x, y, _, qx, qy, qz, qw = values.T
    norm = qx * qx + qy * qy + qz * qz + qw * qw
    if np.any(norm == 0):
        where = f"{path}:{line[norm == 0][0]}"
        raise InputError(where, "a quaternion of length 0", "a unit quaternion qx qy qz qw")
    heading = np.arctan2(2 * (qw * qz + qx * qy), norm - 2 * (qy * qy + qz * qz))
    return t, np.stack([x, y, heading], axis=1)


def write_tum(path: str | Path, time: np.ndarray, pose: np.ndarray) -> None:
    """Writes a planar trajectory; `read_tum` returns the same numbers (headings up to rounding)."""
    lines = (tum_line(*row) for row in zip(time, pose, strict=True))
    Path(path).write_text("".join(lines), encoding="utf-8")


def _positions(estimate: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The positions of both as complex numbers x + iy: [N] each."""
    if len(estimate) != len(reference) or len(estimate) == 0:
        found = f"{len(estimate)} and {len(reference)} rows"
        expected = "the same number of rows, at least one"
        raise InputError("trajectories", found, expected, "interpolate one at the times of the other")
    estimate, reference = np.asarray(estimate, float), np.asarray(reference, float)
    return estimate[:, 0] + 1j * estimate[:, 1], reference[:, 0] + 1j * reference[:, 1]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")
