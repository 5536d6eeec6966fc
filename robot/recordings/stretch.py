"""A stretch of a recording: from one time to another, each counted from the start or absolute."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import AfterValidator, Field, create_model

from tactile.base.errors import InputError
from tactile.base.settings import Settings


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
_WORDS = {"from": "the recording is read from here on, as if it began here", "to": "it is read to here"}
StretchConfig = create_model(
    "StretchConfig",
    __base__=Settings,
    **{
        name: (Moment | None, Field(default=None, description=f"{words}: s from its start, or an ISO time."))
        for name, words in _WORDS.items()
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
