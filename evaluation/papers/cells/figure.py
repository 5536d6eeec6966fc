"""One figure or table of pose cells: what it measures, its lines and its picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple


class CellTask(NamedTuple):
    """What to measure.

    Attributes:
        first: seed of the first session; each session has the next one. sessions: their number, or that of
            repeats; None: the usual number of the figure. workers: processes.
    """

    first: int
    sessions: int | None = None
    workers: int = 1

    def seeds(self, usual: int) -> range:
        """The seeds of the sessions; `usual` of them unless the task says otherwise."""
        return range(self.first, self.first + (self.sessions or usual))


class CellFigure(NamedTuple):
    """A figure; each module of this room that is named in `reproduction.NAMES` offers one as `FIGURE`.

    Attributes:
        title: one line. measure: the result of a task. table: the lines of a Markdown table of the result,
            each figure beside its goal and its control, and sentences about what it does not show. draw:
            draws the result into a new PNG file; None: without a picture.
    """

    title: str
    measure: Callable[[CellTask], Any]
    table: Callable[[Any], Sequence[str]]
    draw: Callable[[Any, Path], None] | None
