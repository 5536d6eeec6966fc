"""Reports the progress of a run to observers, as plain data.

Maps are asked at the end of chunks only, and for what takes long less and less often: the cost of all
questions together stays a small multiple of the last one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from ratslam.core.estimates import GridDrawing, PoseCellActivity
from tactile.base.types import Observation
from tactile.whiskers.head_geometry import Head

DRAWN_SHARE = 16
"""The whole map is reported when the run has grown by this part of its steps."""


class RunDescription(NamedTuple):
    """A run, at its beginning.

    Attributes:
        name: of its source. backend: by name.
        head: the whisker head whose images the views are, or None. tallest: obstacle height of brightness 1
            in them, m. pose_cells: whether the method has them.
    """

    name: str
    backend: str
    head: Head | None = None
    tallest: float = 1.0
    pose_cells: bool = False


class StepReport(NamedTuple):
    """One step.

    Attributes:
        number: of the step, from 0. time: s, on the clock of the source. observation: as mapped.
        odometry: [3] dead reckoning from the first step of the run. pose: [3] online, in the map frame.
        place, previous: id of the present place and of the one before, -1 for none. lost: see `Estimate`.
        doubt: probability that the map is worse than odometry, NaN if not judged.
    """

    number: int
    time: float
    observation: Observation
    odometry: np.ndarray
    pose: np.ndarray
    place: int
    previous: int
    lost: bool
    doubt: float


class MapReport(NamedTuple):
    """The map after a step.

    Attributes:
        closures: [n, 3] earlier step, later step and verdict, see `Map.judged_closures`. activity: of the
            pose cells, if the method has them.
        path: [T, 3] all steps in the present map, and grid: the occupancy grid; None where not due.
    """

    closures: np.ndarray
    activity: PoseCellActivity | None
    path: np.ndarray | None = None
    grid: GridDrawing | None = None


class Observer(Protocol):
    """Is told of the progress of a run. It must neither raise nor wait: the run would do so too."""

    def begin(self, run: RunDescription) -> None:
        """The run begins, after its directory is made."""

    def update(self, steps: Sequence[StepReport], map: MapReport | None) -> None:
        """Steps were mapped; the map is reported at the end of a chunk."""

    def finish(self, map: MapReport) -> None:
        """The run has ended; `path` is the final trajectory."""


class MapSchedule:
    """Decides when the whole map is reported.

    Args:
        steps: of the session so far.
    """

    def __init__(self, steps: int) -> None:
        self._due = steps

    def is_due(self, steps: int) -> bool:
        """Whether it is due after so many steps; the next one is due later."""
        if steps < self._due:
            return False
        self._due = steps + steps // DRAWN_SHARE
        return True
