"""Row by row: is every number finite, every time later than the one before, every view in 0..1?

Asked of a whole recording before anything is run on it. Each check returns the faults it found and never
raises, so that a reader can report all of them at once. Non-finite values are one check's business; the
others look past them. Whether the units can be right is asked in `robot.recordings.unit_check`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tactile.base.errors import InputError

RowName = Callable[[int], str]  # where a row stands in the user's file


def nonfinite_errors(
    values: np.ndarray, what: str, place: RowName, rows: np.ndarray | None = None
) -> list[InputError]:
    """Faults where values [N, ...] of the given rows [N] bool are NaN or infinite."""
    flat = values.reshape(len(values), -1)
    bad = ~np.isfinite(flat)
    hit = bad.any(axis=1) if rows is None else bad.any(axis=1) & rows
    if not hit.any():
        return []
    row = int(hit.argmax())
    found = f"{what} is {flat[row][bad[row]][0]}{count_others(hit)}"
    return [InputError(place(row), found, "a finite number", "mend or drop the row")]


def clock_errors(
    time: np.ndarray, what: str, place: RowName, moved: np.ndarray | None = None
) -> list[InputError]:
    """Faults where time [N] s goes back, or where two rows with odometry (`moved` [N]; all) share one."""
    errors = []
    rows = np.flatnonzero(np.isfinite(time))
    back = np.diff(time[rows]) < 0
    if back.any():
        first = int(back.argmax())
        was, now = time[rows[first : first + 2]].tolist()
        found = f"{what} goes back from {was!r} to {now!r} s{count_others(back)}"
        place_of = place(int(rows[first + 1]))
        errors.append(InputError(place_of, found, "times that increase", "sort the rows by time"))
    rows = rows if moved is None else rows[moved[rows]]
    same = np.diff(time[rows]) == 0
    if same.any():
        row = int(rows[int(same.argmax()) + 1])
        found = f"{what} repeats {float(time[row])!r} s{count_others(same)}"
        errors.append(InputError(place(row), found, "times that increase", "drop the repeated rows"))
    return errors


def view_errors(low: np.ndarray, high: np.ndarray, what: str, place: RowName) -> list[InputError]:
    """Faults where a view's smallest and largest values [N] leave 0..1; NaN stands for no view."""
    hit = (low < 0) | (high > 1)
    if not hit.any():
        return []
    row = int(hit.argmax())
    worst = float(high[row] if high[row] > 1 else low[row])
    most = 255 if np.nanmax(high) <= 255 else f"their largest possible value, at least {np.nanmax(high):g}"
    cure = "shift and scale them" if np.nanmin(low) < 0 else f"divide them by {most}"
    return [InputError(place(row), f"{what} holds {worst!r}{count_others(hit)}", "view values in 0..1", cure)]


def count_others(hit: np.ndarray) -> str:
    """' (and ...)' for the rows [N] bool after the first one told; '' when there are none."""
    others = int(hit.sum()) - 1
    return f" (and so in {others} more row{'s' * (others > 1)})" if others else ""
