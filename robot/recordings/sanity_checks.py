"""Checks of rows: numbers are finite, times increase, view values are in 0..1; and stretches of a recording.

A whole recording is checked before it is used. Each check returns its errors instead of raising them, so
that a reader can report all at once. Only `nonfinite_errors` reports non-finite values; the other checks
ignore them. For units see `robot.recordings.input_judge`.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field, create_model

from tactile.base.errors import InputError
from tactile.base.settings import Settings

RowName = Callable[[int], str]  # position of a row in the user's file, for errors
SPOILT = 0.05
"""Share of the rows or messages, but at least one, that may be left out; more are an error."""


def leave_out(
    count: int, total: int, what: str, first: InputError, warn: Callable[[str], None] | None
) -> list[InputError]:
    """Leaves out `count` of `total` rows or messages: told as a warning, or an error if these are too many.

    Args:
        what: names them. first: why the first cannot be used.
    """
    if count > max(1, SPOILT * total) or count == total > 0:
        found = f"{first.found} (so in {count} of {total} {what})" if count > 1 else first.found
        return [InputError(first.where, found, first.expected, first.cure)]
    if count and warn is not None:
        expected = f"; expected {first.expected}" if first.expected else ""
        warn(f"{first.where}: {first.found}{expected}; {count} of {total} {what} are left out")
    return []


def first_error(
    bad: np.ndarray, place: RowName, found: Callable[[int], str], expected: str, cure: str = ""
) -> list[InputError]:
    """The error for the first of the rows that are bad, [N] bool; none without any."""
    row = int(bad.argmax()) if bad.any() else None
    return [] if row is None else [InputError(place(row), found(row), expected, cure)]


def still_axis(points: np.ndarray) -> str:
    """The axis, x or y, along which a path [N, 3] m hardly moves although it does along z; '' for none."""
    points = points[np.isfinite(points).all(axis=1)]
    x, y, z = np.ptp(points, axis=0) if len(points) else np.zeros(3)
    if z <= max(10.0 * min(x, y), 0.2 * max(x, y)):
        return ""
    return "x" if x < y else "y"


def nonfinite_errors(
    values: np.ndarray, what: str, place: RowName, rows: np.ndarray | None = None, most: float = 1e20
) -> list[InputError]:
    """Errors where values [N, ...] in the given rows [N] bool (default all) are NaN, infinite or over `most`,
    so that sums and squares lose what they are added to."""
    flat = values.reshape(len(values), -1)
    bad = ~(np.abs(flat) <= most)
    hit = bad.any(axis=1) if rows is None else bad.any(axis=1) & rows
    if not hit.any():
        return []
    row = int(hit.argmax())
    found = f"{what} is {flat[row][bad[row]][0]}{count_others(hit)}"
    expected = "a finite number" + (f" up to {most:g}" if np.isfinite(flat[row][bad[row]][0]) else "")
    return [InputError(place(row), found, expected, "correct or drop the row")]


def clock_errors(
    time: np.ndarray, what: str, place: RowName, moved: np.ndarray | None = None
) -> list[InputError]:
    """Errors where time [N] s decreases, or is equal in two rows with odometry (`moved` [N], default all)."""
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
    """Errors where the smallest or largest view value [N] is outside 0..1; NaN means no view."""
    hit = (low < 0) | (high > 1)
    if not hit.any():
        return []
    most = 255 if np.nanmax(high) <= 255 else f"their largest possible value, at least {np.nanmax(high):g}"
    cure = "shift and scale them" if np.nanmin(low) < 0 else f"divide them by {most}"
    worst = np.where(high > 1, high, low)
    found = lambda row: f"{what} holds {float(worst[row])!r}{count_others(hit)}"  # noqa: E731
    return first_error(hit, place, found, "view values in 0..1", cure)


def count_others(hit: np.ndarray) -> str:
    """Text ' (and ...)' that counts the rows [N] bool after the first one; '' if there are none."""
    others = int(hit.sum()) - 1
    return f" (and so in {others} more row{'s' * (others > 1)})" if others else ""


def utc_seconds(text: str) -> float:
    """s since 1970 (UTC) of an ISO time, without an offset that of UTC; raises `ValueError`."""
    found = datetime.fromisoformat(text)
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()


def _check_time(value: float | str) -> float | str:
    if isinstance(value, str):
        try:
            utc_seconds(value)
        except ValueError:
            raise ValueError(f"{value!r} is neither a number of seconds nor an ISO time") from None
    return value


Moment = Annotated[float | str, AfterValidator(_check_time)]
"""s from the start of the recording, or an ISO time such as 2024-05-01T10:00:00+02:00; UTC without offset."""
StretchConfig = create_model(
    "StretchConfig",
    __base__=Settings,
    **{
        name: (Moment | None, Field(default=None, description=f"{words}: s from its start, or an ISO time."))
        for name, words in (
            ("from", "the recording is read from here on, as if it began here"),
            ("to", "it is read to here"),
        )
    },
)  # type: ignore[call-overload]
"""The settings `from` and `to`; the first is a keyword of Python, which no class can name."""


class Stretch(NamedTuple):
    """A stretch. Attributes: first, last: s from the start, or an ISO time; None: the start, the end."""

    first: float | str | None = None
    last: float | str | None = None

    def inside(self, time: np.ndarray, start: float) -> np.ndarray:
        """[N] bool, the times [N] s within the stretch of a recording that starts at `start` s."""
        ends = (-np.inf if self.first is None else self.first, np.inf if self.last is None else self.last)
        first, last = (utc_seconds(end) if isinstance(end, str) else start + end for end in ends)
        return (time >= first) & (time <= last)

    def rows(self, time: np.ndarray, where: str) -> np.ndarray:
        """[N] bool, the times [N] s of a recording within the stretch.

        Raises:
            InputError: none is.
        """
        if self == WHOLE or not len(time):
            return np.ones(len(time), bool)
        inside = self.inside(time, float(time[np.isfinite(time)].min(initial=np.inf)))
        if not inside.any():
            found = f"nothing from {self.first or 'the start'} to {self.last or 'the end'}"
            expected = f"a stretch of it: it goes from {np.nanmin(time):.3f} to {np.nanmax(time):.3f} s"
            raise InputError(where, found, expected, "set recording.from and recording.to")
        return inside

    def digest(self, digest: str) -> str:
        """The digest of this stretch of a recording with that digest."""
        return digest if self == WHOLE else f"{digest}[{self.first}:{self.last}]"


WHOLE = Stretch()
