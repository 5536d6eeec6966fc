"""Records the pose cells of a run: rows go to a file while it runs, which becomes cells.npz at the end.

`plan_recording` says which cells are recorded, and over which bins all of them are summed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from evaluation.cells.recording import NAME, BinnedSums, CellRecording, write_recording
from ratslam.classic.cell_probe import choose_cells
from ratslam.core.backend import Backend, PoseCellProbe
from ratslam.core.session import CHUNK, Probe, Step
from ratslam.runs.settings.run_config import RunConfig
from robot.sources.in_memory import InMemorySource, SimulatedSource
from robot.sources.source import Sample, Source
from robot.touch_source import TouchSource
from tactile.base.errors import InputError

LARGEST_SUMS = 2**31
"""Most memory for sums, bytes."""


Bins = tuple[np.ndarray, np.ndarray, int]
"""Edges of the place bins, [W + 1] along x and [H + 1] along y, m, and number of heading bins."""


class RecordingPlan(NamedTuple):
    """cells: of the method. cell: [C] int32 chosen cells in the flattened network. probe: of the session,
    whose steps have the activity of the chosen cells [C], float32, and where all cells are summed what was
    held of them. bins: over which all cells are summed; None without sums."""

    cells: PoseCellProbe
    cell: np.ndarray
    probe: Probe
    bins: Bins | None = None


def plan_recording(config: RunConfig, source: Source, backend: Backend) -> RecordingPlan | None:
    """The plan for a completed configuration, its source and its method; None: nothing is recorded.

    Raises:
        InputError: the method has no pose cells, the network not the chosen ones, the extent of the place
            bins is not known, or the sums need too much memory.
    """
    if config.cells is None:
        return None
    sheet = config.cells.sheet
    cells = backend.probe() if sheet is None else backend.sheet_probe(sheet)
    if cells is None and sheet is not None:
        found = f"`backend: {config.backend}`, whose cells hold no belief"
        raise InputError("cells.sheet", found, "`backend: recall`", "or remove `cells.sheet`")
    if cells is None:
        found = f"`backend: {config.backend}`, a method without pose cells"
        raise InputError("cells", found, "`backend: recall` or `backend: classic`", "or remove `cells`")
    sums, cell = config.cells.sums, choose_cells(config.cells.chosen, cells.shape, config.session.seed)
    probe = Probe(lambda state: cells.each(state, cell))
    if sums is None:
        return RecordingPlan(cells, cell, probe)
    size = 8 * int(np.prod(cells.shape)) * (sums.bins**2 + sums.heading_bins)
    if size > LARGEST_SUMS:
        found = f"sums of {np.prod(cells.shape)} cells, which need {size / 2**30:.1f} GiB"
        raise InputError(
            "cells.sums", found, f"at most {LARGEST_SUMS >> 30} GiB", "choose fewer bins or a smaller network"
        )
    extent = _true_extent(source, cells.cell_size) if sums.extent is None else sums.extent
    if extent is None:
        found = f"missing, and {source.name} does not tell its true path before the run"
        raise InputError("cells.sums.extent", found, "[x0, y0, x1, y1] of the binned rectangle, m")
    x0, y0, x1, y1 = extent
    x_edges, y_edges = np.linspace(x0, x1, sums.bins + 1), np.linspace(y0, y1, sums.bins + 1)
    probe = probe._replace(seldom=cells.hold, interval=max(1, round(source.rate_hz / sums.rate)))
    return RecordingPlan(cells, cell, probe, (x_edges, y_edges, sums.heading_bins))


def _true_extent(source: Source, least: float) -> tuple[float, float, float, float] | None:
    """The rectangle round the true positions, with sides of at least `least`, m."""
    while isinstance(source, TouchSource):
        source = source.source
    if not isinstance(source, InMemorySource | SimulatedSource) or source.truth is None:
        return None
    at = source.truth[:, :2]
    at = at[np.isfinite(at).all(axis=1)]
    if not len(at):
        return None
    (x0, y0), (x1, y1) = at.min(axis=0).tolist(), at.max(axis=0).tolist()
    return x0, y0, max(x1, x0 + least), max(y1, y0 + least)


ROWS = "cells.rows"
"""File of the rows of a run that goes on, or was killed: plain records."""
BUFFERED = 32 * CHUNK
"""Rows kept in memory before they are appended to the file."""


def step_columns(
    cells: PoseCellProbe, samples: Sequence[Sample], steps: Sequence[Step]
) -> dict[str, np.ndarray]:
    """The columns of `CellRecording` over steps and the samples of the source that they belong to."""
    unknown = np.full(3, np.nan)
    return {
        "time": np.array([sample.time for sample in samples]),
        "truth": np.array([unknown if sample.truth is None else sample.truth for sample in samples]),
        "packet": np.array([cells.packet(step.evidence) for step in steps]),
        "energy": np.array([cells.energy(step.evidence) for step in steps]),
        "place": np.array([step.estimate.place for step in steps], np.int32),
        "activity": np.array([step.probed for step in steps], np.float32),
    }


class CellRecorder:
    """Records the steps of a session whose probe is that of the plan.

    Its memory is that of the sums and of `BUFFERED` rows, however long the session is.

    Args:
        directory: of the run, where `cells.rows` and `cells.npz` are written.
    """

    def __init__(self, directory: Path, plan: RecordingPlan) -> None:
        self._directory, self._plan = directory, plan
        row = [  # of one step, as the fields of `CellRecording`
            ("time", "<f8"),
            ("truth", "<f8", 3),
            ("packet", "<f8", 3),
            ("energy", "<f8"),
            ("place", "<i4"),
            ("activity", "<f4", (len(plan.cell),)),
        ]
        self._rows = np.zeros(BUFFERED, np.dtype(row))
        self._filled = 0
        self._sums: CellSums | None = None
        (directory / ROWS).touch(exist_ok=False)

    def add(self, samples: Sequence[Sample], steps: Sequence[Step]) -> None:
        """Adds up to one chunk of steps, and the samples of the source that they belong to."""
        if self._filled + len(steps) > BUFFERED:
            self._write()
        rows = self._rows[self._filled : self._filled + len(steps)]
        for name, values in step_columns(self._plan.cells, samples, steps).items():
            rows[name] = values
        self._filled += len(steps)
        if self._plan.bins is None:
            return
        if self._sums is None:
            self._sums = CellSums(self._plan.bins, int(np.prod(self._plan.cells.shape)), samples[0].time)
        self._sums.add_steps(self._plan.cells, samples, steps)

    def finish(self) -> None:
        """Writes cells.npz with all rows and the sums, and removes cells.rows.

        Raises:
            OSError: the disk is full; the rows written so far stay.
        """
        self._write()
        path, plan = self._directory / ROWS, self._plan
        kind = self._rows.dtype
        rows = np.memmap(path, kind, mode="r") if path.stat().st_size else np.zeros(0, kind)
        sums = None if self._sums is None else self._sums.result()
        columns = {name: rows[name] for name in kind.names or ()}
        recording = CellRecording(
            plan.cells.shape, plan.cells.cell_size, **columns, cell=plan.cell, sums=sums
        )
        write_recording(self._directory / NAME, recording)
        path.unlink()

    def _write(self) -> None:
        with (self._directory / ROWS).open("ab") as file:
            file.write(self._rows[: self._filled].tobytes())
        self._filled = 0


class CellSums:
    """Adds the activity of a number of cells, step by step, in memory that does not grow.

    Args:
        began: time from which the first step counts, s.
    """

    def __init__(self, bins: Bins, cells: int, began: float) -> None:
        self._x_edges, self._y_edges, self._turns = bins
        self._until = began
        self._width, self._height = len(self._x_edges) - 1, len(self._y_edges) - 1
        self._place = np.zeros((self._height * self._width, cells))
        self._heading = np.zeros((self._turns, cells))
        self._place_seconds = np.zeros(self._height * self._width)
        self._heading_seconds = np.zeros(self._turns)

    def add(self, time: float, truth: np.ndarray | None, cell: np.ndarray, activity: np.ndarray) -> None:
        """Adds a step, for the time since the one before.

        Args:
            time: s. truth: [3] true pose. Without one, or outside the bins, the step and its time are left
                out. cell: [n] active cells, where one may come twice. activity: [n] of them.
        """
        elapsed, self._until = time - self._until, time
        at = None if truth is None else self._bins(truth)
        if at is None:
            return
        place, heading = at
        share = elapsed * activity.astype(np.float64)
        np.add.at(self._place[place], cell, share)
        np.add.at(self._heading[heading], cell, share)
        self._place_seconds[place] += elapsed
        self._heading_seconds[heading] += elapsed

    def add_steps(self, cells: PoseCellProbe, samples: Sequence[Sample], steps: Sequence[Step]) -> None:
        """Adds the steps whose activity of all cells was held."""
        for sample, step in zip(samples, steps, strict=True):
            if step.seldom is not None:
                self.add(sample.time, sample.truth, *cells.active(step.seldom))

    def result(self) -> BinnedSums:
        """The sums so far, float32."""
        grid = (self._height, self._width)
        return BinnedSums(
            x_edges=self._x_edges,
            y_edges=self._y_edges,
            seconds=self._place_seconds.reshape(grid),
            place=np.ascontiguousarray(self._place.T, np.float32).reshape(-1, *grid),
            heading_seconds=self._heading_seconds,
            heading=np.ascontiguousarray(self._heading.T, np.float32),
        )

    def _bins(self, truth: np.ndarray) -> tuple[int, int] | None:
        """The place bin (row by row) and the heading bin of a true pose, None outside."""
        if not np.isfinite(truth).all():
            return None
        at = []
        for edges, value in ((self._x_edges, truth[0]), (self._y_edges, truth[1])):
            if not edges[0] <= value <= edges[-1]:
                return None
            # The last bin holds its upper edge.
            at.append(min(int(np.searchsorted(edges, value, side="right")), len(edges) - 1) - 1)
        column, row = at
        return row * self._width + column, round(float(truth[2]) / (2 * np.pi) * self._turns) % self._turns
