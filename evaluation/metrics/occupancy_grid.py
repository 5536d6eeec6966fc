"""Occupancy maps, the truth they are held against, and which cells of it a whisker can tell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

PRIOR_OCCUPANCY = 0.3
"""Occupancy where nothing was felt (Fox et al. 2012, III)."""
SURFACE_SPACING = 0.01
"""Of the points that stand for the true walls, m."""

_EVIDENCE = 1e-4  # a probability nearer to the prior was not touched: stamps are Gaussians, which end nowhere
_NEAR, _FAR = 0.45, 0.95  # cells; from a wall on their borders or centres neither ends on a border
_SKIN = 1 - 1e-6  # cells: a wall on the centres of cells has one layer, as one on their borders has


class OccupancyGrid(NamedTuple):
    """An occupancy map.

    Attributes:
        probability: [H, W] in 0..1; row j counts y upwards, column i counts x.
        origin: [2] m, the lower left corner of cell (0, 0). cell: its side, m.
    """

    probability: np.ndarray
    origin: np.ndarray
    cell: float


class GridTruth(NamedTuple):
    """What is really there, on the cells of a map and exactly.

    Attributes:
        occupied: [H, W] bool, the cell's centre lies in something solid; beyond the outer wall it may say
            anything. inside: [H, W] bool, within the outer wall. segments: [S, 4] the surfaces of walls and
            objects, x1, y1, x2, y2 in m.
    """

    occupied: np.ndarray
    inside: np.ndarray
    segments: np.ndarray


class TouchableSurface(NamedTuple):
    """What of a truth can be felt from its free space.

    Attributes:
        free: [H, W] bool, cells inside the arena that hold nothing.
        wall: [H, W] bool, all others whose centre is within one cell of a surface that faces a free cell:
            the skin of objects, and one ring around the arena even where its wall has no thickness.
        points: [K, 2] m, those surfaces, a point every `SURFACE_SPACING`.
    """

    free: np.ndarray
    wall: np.ndarray
    points: np.ndarray


def cell_centres(grid: OccupancyGrid) -> np.ndarray:
    """[H, W, 2] centres of the cells, m."""
    height, width = grid.probability.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.asarray(grid.origin) + grid.cell * np.stack([x, y], axis=-1)


def has_evidence(grid: OccupancyGrid, prior: float = PRIOR_OCCUPANCY) -> np.ndarray:
    """[H, W] bool, where evidence moved the map away from its prior."""
    return np.abs(grid.probability - prior) > _EVIDENCE


def check_grid(grid: OccupancyGrid, truth: GridTruth | None = None) -> None:
    """Refuses a map that is none, or that lies on other cells than its truth (ValueError)."""
    shape = grid.probability.shape
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"a map has rows and columns, not the shape {shape}")
    if not (np.isfinite(grid.origin).all() and grid.cell > 0):
        raise ValueError(f"no place for a map: origin {grid.origin}, cell {grid.cell}")
    if not ((grid.probability >= 0) & (grid.probability <= 1)).all():
        raise ValueError("a map holds probabilities: 0 to 1, and never NaN")
    if truth is None:
        return
    if not shape == truth.occupied.shape == truth.inside.shape:
        raise ValueError(f"truth of {truth.occupied.shape}, {truth.inside.shape} cells, map of {shape}")
    if truth.segments.ndim != 2 or truth.segments.shape[1] != 4 or not np.isfinite(truth.segments).all():
        raise ValueError("walls are segments [S, 4] of finite numbers")


def touchable_surface(grid: OccupancyGrid, truth: GridTruth) -> TouchableSurface:
    """What of the truth can be felt, on the cells of the map.

    A surface faces free space where about half a cell or a whole one away from it, to either side, the cell
    is free; so the face by which an object leans on a wall does not count.
    """
    from scipy.spatial import cKDTree

    free = truth.inside & ~truth.occupied
    points, normals = _points(truth.segments)
    faces = np.zeros(len(points), bool)
    for step in (-_FAR, -_NEAR, _NEAR, _FAR):
        faces |= _at(free, grid, points + step * grid.cell * normals)
    points = points[faces]
    if len(points) == 0:
        return TouchableSurface(free, np.zeros_like(free), points)
    away, _ = cKDTree(points).query(cell_centres(grid))
    return TouchableSurface(free, ~free & (away < _SKIN * grid.cell), points)


def truth_occupancy(truth: GridTruth, wall: np.ndarray, outside: float = PRIOR_OCCUPANCY) -> np.ndarray:
    """[H, W] the truth as occupancy: 1 in objects and walls, 0 in free space, `outside` beyond (Fig. 3 of Fox
    et al. 2012)."""
    return np.where(wall | (truth.inside & truth.occupied), 1.0, np.where(truth.inside, 0.0, outside))


def mean_grid(grids: Sequence[OccupancyGrid]) -> OccupancyGrid:
    """The mean of maps on the same cells (Fig. 4 of Fox et al. 2012)."""
    first = grids[0]
    for grid in grids:
        check_grid(grid)
        if grid.probability.shape != first.probability.shape or grid.cell != first.cell:
            raise ValueError("maps on different cells have no mean")
        if not np.array_equal(grid.origin, first.origin):
            raise ValueError("maps at different places have no mean")
    return first._replace(probability=np.mean([grid.probability for grid in grids], axis=0))


def _points(segments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points along segments [S, 4] and the unit normals there: [K, 2] each."""
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    length = np.hypot(*along.T)
    count = np.ceil(length / SURFACE_SPACING - 1e-6).astype(int)
    row = np.repeat(np.arange(len(segments)), count)
    first = np.repeat(np.cumsum(count) - count, count)
    share = (np.arange(len(row)) - first + 0.5) / count[row]
    normal = np.stack([-along[row, 1], along[row, 0]], axis=1) / length[row, None]
    return start[row] + share[:, None] * along[row], normal


def _at(cells: np.ndarray, grid: OccupancyGrid, points: np.ndarray) -> np.ndarray:
    """The value [K] of the cells [H, W] bool at points [K, 2]; False outside."""
    column, row = np.floor((points - grid.origin) / grid.cell).astype(int).T
    known = (row >= 0) & (row < cells.shape[0]) & (column >= 0) & (column < cells.shape[1])
    found = np.zeros(len(points), bool)
    found[known] = cells[row[known], column[known]]
    return found
