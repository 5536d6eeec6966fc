"""Files `grid.npz` (occupancy map) and `arena.npz` (its ground truth)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from evaluation.metrics.occupancy_grid import GridTruth, OccupancyGrid, check_grid
from tactile.base.npz import read_npz


def read_grid(path: str | Path) -> OccupancyGrid:
    """Reads the map of a run with a grid.

    Raises:
        InputError: the file is missing or malformed.
    """

    def parse(probability: np.ndarray, origin: np.ndarray, cell: np.ndarray) -> OccupancyGrid:
        grid = OccupancyGrid(probability.astype(float), origin.astype(float).reshape(2), float(cell))
        check_grid(grid)
        return grid

    expected = "an occupancy map: probability [H, W], origin [2] and cell"
    return read_npz(path, OccupancyGrid._fields, parse, expected)


def write_grid_truth(path: str | Path, truth: GridTruth, start: np.ndarray) -> None:
    """Writes the truth in the frame of the map, and `start` [3]: the pose of that frame (where the robot
    started) in the frame of the true poses."""
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **truth._asdict(), start=start)


def read_grid_truth(path: str | Path) -> tuple[GridTruth, np.ndarray]:
    """The inverse of `write_grid_truth`.

    Raises:
        InputError: the file is missing or malformed.
    """

    def parse(*arrays: np.ndarray) -> tuple[GridTruth, np.ndarray]:
        occupied, inside, segments, start = arrays
        return GridTruth(occupied, inside, segments.astype(float)), start.astype(float)

    return read_npz(path, (*GridTruth._fields, "start"), parse, "the arena.npz of a run directory")
