"""One row of the table of saved maps: its sessions, its lines, its picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from evaluation.metrics.statistics import wilson_interval
from evaluation.papers.maps.sessions import Recipe, Recorded
from evaluation.papers.maps.stored_maps import MapArrays, StoredMap, store_map
from evaluation.papers.tables.comparison import Record
from evaluation.papers.tables.markdown import markdown_header, markdown_row

COLUMNS = ("figure", "goal", "measured", "control")


class Localised(NamedTuple):
    """A session of T steps in a map that does not change.

    Attributes:
        found: [T] bool, whether the robot says that it knows where it is. foreign: [T] bool, whether it says
            that it is not in this map. pose: [T, 3] in the map (m, m, rad).
    """

    found: np.ndarray
    foreign: np.ndarray
    pose: np.ndarray


class Methods(NamedTuple):
    """Operations on saved maps; functions of a module, so that other processes can import them.

    Attributes:
        localise: a session in a map. extend: the map of a session and then another one, whose robot may stand
            anywhere: its arrays are over the steps of both, in this order. merge: one map of several, written
            to a new path, and its arrays over the steps of all, in the order of the arguments. changes:
            places [n, 2] of a map (m) where a session says that it no longer agrees, the surest first.
    """

    localise: Callable[[StoredMap, Recorded], Localised]
    extend: Callable[[StoredMap, Recorded], MapArrays]
    merge: Callable[[Sequence[StoredMap], Path], StoredMap]
    changes: Callable[[StoredMap, Recorded], np.ndarray]


class MapTask(NamedTuple):
    """One session of a row.

    Attributes:
        seed: of its maze; in rows of recordings, the number of the recording. folder: for maps. methods: what
            is measured.
    """

    seed: int
    folder: Path
    methods: Methods

    def map_of(self, recipe: Recipe) -> StoredMap:
        """The map of a session, made once for all rows."""
        return store_map(recipe, self.folder)


class Line(NamedTuple):
    """A line of a row's table: a figure, its goal, what was measured, and the same of the control."""

    figure: str
    goal: str
    measured: str
    control: str


class MapRow(NamedTuple):
    """A row.

    Attributes:
        title: one line. sessions: their usual number. measure: the figures of one session. record: these by
            name, each a number, or whether the session fails in something. lines: of the figures of all.
            draw: draws these into a new PNG file. recordings: names of the recordings that are used instead
            of mazes.
    """

    title: str
    sessions: int
    measure: Callable[[MapTask], Any]
    record: Callable[[Any], Record]
    lines: Callable[[Sequence[Any]], Iterable[Line]]
    draw: Callable[[Sequence[Any], Path], None]
    recordings: tuple[str, ...] = ()

    def seeds(self, first: int, sessions: int | None) -> range:
        """The seeds of its tasks, from that of the first maze and the number of sessions (None: the
        usual)."""
        if self.recordings:
            return range(len(self.recordings))[:sessions]
        return range(first, first + (sessions or self.sessions))

    def table(self, found: Sequence[Any]) -> list[str]:
        """The lines of a Markdown table."""
        return [markdown_header(COLUMNS), *(markdown_row(line) for line in self.lines(found))]


def median(values: np.ndarray) -> float:
    """Median of values [n]; NaN of none."""
    return float(np.median(values)) if len(values) else np.nan


def count(happened: Sequence[bool] | np.ndarray) -> str:
    """How many of the sessions [n] bool, with the 95 % interval of the rate in percent."""
    number, total = int(np.sum(happened)), len(happened)
    if not total:
        return "-"
    low, high = wilson_interval(number, total)
    return f"{number} of {total} [{100 * low:.0f}-{100 * high:.0f} %]"


def spread(values: Sequence[float] | np.ndarray, digits: int = 2) -> str:
    """Median and largest of values; `-` without a finite one."""
    known = np.asarray(values, float)
    known = known[~np.isnan(known)]
    if not len(known):
        return "-"
    return f"{np.median(known):.{digits}f} ({known.max():.{digits}f})"
