"""The recorded activity of cells: of pose cells, type and file; of an animal's cells, made from spikes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from tactile.base.bounded import read_npz
from tactile.base.errors import InputError
from tactile.base.files import write_atomically

NAME = "cells.npz"
"""The file in a run directory."""
FORMAT = "ratslam-cells-1"
"""Text `format` in the file."""
GAP = 10.0
"""Median intervals between samples above which the place is unknown in between."""


class BinnedSums(NamedTuple):
    """The activity of all cells, summed over time into bins of the true position and heading.

    Attributes:
        x_edges: [W + 1] m. y_edges: [H + 1] m. seconds: [H, W] time in each bin, s. place: [cells, H, W]
            activity times time, s; the mean activity in a bin is `place / seconds`. heading_seconds: [B] time
            at each heading, s; bin b is centred on 2 pi b / B rad. heading: [cells, B] activity times time,
            s. Cells are in the order of the flattened network [K, N, N] over heading, y, x.
    """

    x_edges: np.ndarray
    y_edges: np.ndarray
    seconds: np.ndarray
    place: np.ndarray
    heading_seconds: np.ndarray
    heading: np.ndarray

    def parts(self, cells: int = 256) -> Iterator[Self]:
        """The sums of so many cells at a time, whose arrays fit the cache."""
        for start in range(0, max(len(self.place), 1), cells):
            part = slice(start, start + cells)
            yield self._replace(place=self.place[part], heading=self.heading[part])


class CellRecording(NamedTuple):
    """The activity of cells over the T steps of a session.

    Attributes:
        shape: (K, N, N) cells of the network over heading, y, x; of a twisted sheet of grid cells fewer over
            y; (0, 0, 0) of cells of an animal, whose activity is in spikes/s (`record_spikes`). cell_size:
            side of a cell, m.
        time: [T] s. truth: [T, 3] true pose, m, m, rad, NaN where unknown. packet: [T, 3] decoded pose over
            x, y, heading, cells. energy: [T] injected by views; of a belief its total. place: [T] int32 id of
            the place or view template, -1 for none.
        cell: [C] int32 indices of the chosen cells in the flattened network. activity: [T, C] float32 of the
            chosen cells; the activity of all cells sums to 1, or to the certainty of a belief.
        sums: of all cells, None if they were not summed.
    """

    shape: tuple[int, int, int]
    cell_size: float
    time: np.ndarray
    truth: np.ndarray
    packet: np.ndarray
    energy: np.ndarray
    place: np.ndarray
    cell: np.ndarray
    activity: np.ndarray
    sums: BinnedSums | None

    @property
    def packet_pose(self) -> np.ndarray:
        """[T, 3] decoded poses on the torus, cells to m, m, rad."""
        scale = [self.cell_size, self.cell_size, 2 * np.pi / self.shape[0]]
        return np.asarray(self.packet, np.float64) * scale

    @property
    def torus_sides(self) -> tuple[float, float, float]:
        """Periods of the torus over x, y (m) and heading (rad).

        A sheet with fewer rows than columns is twisted (`ratslam.network.grid_cells`): a turn along y shifts
        x by half a turn, so that two of them are a period.
        """
        _, height, width = self.shape
        return width * self.cell_size, height * self.cell_size * (1 + (height < width)), 2 * np.pi


def record_spikes(
    time: np.ndarray,
    truth: np.ndarray,
    spikes: Sequence[np.ndarray],
    observed: np.ndarray | None = None,
) -> CellRecording:
    """Spikes of cells of an animal on its path, as a recording with an activity in spikes/s.

    A spike belongs to the nearest sample, as in pynapple. Between samples that lie more than `GAP` median
    intervals apart the place is unknown, and that time and its spikes do not count.

    Args:
        time: [T] s, increasing. truth: [T, 3] m, m, rad, NaN where unknown. spikes: of each of C cells the
            times [n], s. observed: [K, 2] s, outside of which nothing counts; None: all of it.

    Raises:
        InputError: there are no cells, lengths differ, or times do not increase.
    """
    time, truth = np.asarray(time, np.float64), np.asarray(truth, np.float64)
    steps = np.diff(time)
    if not len(spikes) or truth.shape != (len(time), 3) or len(time) < 2 or not (steps > 0).all():
        found = f"{len(time)} times, poses of shape {truth.shape} and {len(spikes)} cells"
        raise InputError("spikes", found, "[T] increasing times, [T, 3] poses and one cell or more")
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > GAP * usual)
    ends = np.repeat(
        gaps + 1, 2
    )  # a sample of unknown place follows each gap's begin, another precedes its end
    time = np.insert(time, ends, np.column_stack([time[gaps] + usual, time[gaps + 1] - usual]).ravel())
    truth = np.insert(truth, ends, np.nan, axis=0)
    if observed is not None:
        outside = [(time < first) | (time > last) for first, last in observed]
        truth[np.all(outside, axis=0)] = np.nan
    middle = (time[1:] + time[:-1]) / 2
    borders = np.concatenate([[time[0] - usual / 2], middle, [time[-1] + usual / 2]])
    seconds = np.diff(time, prepend=time[0] - usual)[:, None]
    counts = np.stack([np.histogram(each, borders)[0] for each in spikes], axis=1)
    unknown = np.full((len(time), 3), np.nan)
    return CellRecording(
        (0, 0, 0), np.nan, time, truth, unknown, unknown[:, 0], np.full(len(time), -1, np.int32),
        np.arange(len(spikes), dtype=np.int32), counts / seconds, None,
    )  # fmt: skip


_SUMS = "sums/"
_STEPS = ("time", "truth", "packet", "energy", "place", "activity")


def write_recording(path: str | Path, recording: CellRecording) -> None:
    """Writes a recording as .npz, atomically; equal recordings give equal bytes.

    The arrays have the names of the fields; those of `sums` follow `sums/` and are empty without sums. Arrays
    that are memory-mapped are written piece by piece.
    """
    sums = recording.sums or BinnedSums(*(np.zeros(0) for _ in BinnedSums._fields))
    arrays: dict[str, Any] = {name: value for name, value in recording._asdict().items() if name != "sums"}
    arrays |= {_SUMS + name: value for name, value in sums._asdict().items()}

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez_compressed(file, format=np.array(FORMAT), **arrays)

    write_atomically(Path(path), write)


def read_recording(path: str | Path) -> CellRecording:
    """The inverse of `write_recording`.

    Raises:
        InputError: the file is missing, broken or of another kind.
    """
    own = [name for name in CellRecording._fields if name != "sums"]
    names = ["format", *own, *(_SUMS + name for name in BinnedSums._fields)]

    def parse(*found: np.ndarray) -> CellRecording:
        kind, shape, cell_size, *arrays = found
        if kind.shape or str(kind) != FORMAT:
            raise ValueError(f"the format {str(kind)[:40]!r}")
        sums = BinnedSums(*arrays[len(own) - 2 :])
        heading, y, x = (int(count) for count in shape)
        steps = (*arrays[: len(own) - 2], sums if sums.x_edges.size else None)
        made = CellRecording((heading, y, x), float(cell_size), *steps)  # type: ignore[arg-type]
        _check(made)
        return made

    return read_npz(path, names, parse, f"recorded cells ({FORMAT})")


def _check(made: CellRecording) -> None:
    """Raises ValueError for arrays that do not fit each other."""
    steps, cells = len(made.time), int(np.prod(made.shape))
    expected: dict[str, tuple[int, ...]] = {name: (steps,) for name in _STEPS}
    expected |= {"truth": (steps, 3), "packet": (steps, 3), "activity": (steps, len(made.cell))}
    fits = all(getattr(made, name).shape == shape for name, shape in expected.items())
    fits &= made.cell.ndim == 1 and not ((made.cell < 0) | (made.cell >= cells)).any()
    sums = made.sums
    if sums is not None:
        grid, headings = (len(sums.y_edges) - 1, len(sums.x_edges) - 1), len(sums.heading_seconds)
        fits &= sums.seconds.shape == grid and sums.place.shape == (cells, *grid)
        fits &= sums.heading.shape == (cells, headings)
    if not fits:
        raise ValueError("arrays that do not fit each other")
