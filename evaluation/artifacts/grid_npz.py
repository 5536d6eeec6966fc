"""Files `grid.npz` (occupancy map) and `arena.npz` (its ground truth)."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from evaluation.metrics.occupancy_grid import GridTruth, OccupancyGrid, check_grid
from tactile.base.errors import InputError


def write_grid(path: str | Path, grid: OccupancyGrid) -> None:
    """Writes a map to an .npz file; equal maps give equal bytes."""
    check_grid(grid)
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **{name: np.asarray(array) for name, array in grid._asdict().items()})  # type: ignore[arg-type]


def read_grid(path: str | Path) -> OccupancyGrid:
    """The inverse of `write_grid`.

    Raises:
        InputError: the file is missing or holds something else.
    """
    expected = "probability [H, W], origin [2] and cell"
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            probability, origin, cell = (archive[name] for name in OccupancyGrid._fields)
        grid = OccupancyGrid(probability.astype(float), origin.astype(float).reshape(2), float(cell))
        check_grid(grid)
    except FileNotFoundError:
        raise InputError(str(path), "no such file", expected) from None
    except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(str(path), f"not an occupancy map ({error})", expected) from None
    return grid


def write_grid_truth(path: str | Path, truth: GridTruth, start: np.ndarray) -> None:
    """Writes the truth in the frame of the map, and `start` [3]: the pose of that frame (where the robot
    started) in the frame of the true poses."""
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **truth._asdict(), start=start)


def read_grid_truth(path: str | Path) -> tuple[GridTruth, np.ndarray]:
    """The inverse of `write_grid_truth`.

    Raises:
        InputError: the file is missing or holds something else.
    """
    expected = "the arena.npz of a run directory"
    try:
        with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as archive:
            occupied, inside, segments, start = (archive[name] for name in (*GridTruth._fields, "start"))
    except FileNotFoundError:
        raise InputError(str(path), "no such file", expected) from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(str(path), f"not the truth of a map ({error})", expected) from None
    return GridTruth(occupied, inside, segments.astype(float)), start.astype(float)
