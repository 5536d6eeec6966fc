"""Occupancy grids, their ground truth, and the surfaces that whiskers can touch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

PRIOR_OCCUPANCY = 0.3
"""Occupancy of cells without evidence (Fox et al. 2012, III)."""
SURFACE_SPACING = 0.01
"""Spacing of the points that sample the true walls, m."""

_NEAR, _FAR = 0.45, 0.95  # cells; from a wall on cell borders or centres, neither ends on a border
_SKIN = 1 - 1e-6  # cells; gives walls on cell centres and on cell borders one layer each


class OccupancyGrid(NamedTuple):
    """An occupancy map.

    Attributes:
        probability: [H, W] in 0..1; row j counts y upwards, column i counts x.
        origin: [2] lower left corner of cell (0, 0), m. cell: side length of a cell, m.
    """

    probability: np.ndarray
    origin: np.ndarray
    cell: float

    def check(self, truth: GridTruth | None = None) -> None:
        """Checks a map, and that it has the cells of its truth (ValueError)."""
        shape = self.probability.shape
        if len(shape) != 2 or 0 in shape:
            raise ValueError(f"a map of shape {shape}; expected [H, W]")
        if not (np.isfinite(self.origin).all() and self.cell > 0):
            raise ValueError(f"origin {self.origin}, cell {self.cell}; expected finite and positive")
        if not ((self.probability >= 0) & (self.probability <= 1)).all():
            raise ValueError("a map with a value outside 0..1 or NaN; expected probabilities")
        if truth is None:
            return
        if not shape == truth.occupied.shape == truth.inside.shape:
            raise ValueError(f"truth of {truth.occupied.shape}, {truth.inside.shape} cells, map of {shape}")
        if truth.segments.ndim != 2 or truth.segments.shape[1] != 4 or not np.isfinite(truth.segments).all():
            raise ValueError("walls that are not segments [S, 4] of finite numbers")


class GridTruth(NamedTuple):
    """The true world, on the cells of a map and as segments.

    Attributes:
        occupied: [H, W] bool, the cell's centre is inside an object or wall; undefined beyond the outer wall.
        inside: [H, W] bool, within the outer wall. segments: [S, 4] surfaces of walls and objects,
            x1, y1, x2, y2, m.
    """

    occupied: np.ndarray
    inside: np.ndarray
    segments: np.ndarray

    def occupancy(self, wall: np.ndarray, outside: float = PRIOR_OCCUPANCY) -> np.ndarray:
        """The truth as occupancy [H, W] (Fox et al. 2012, Fig. 3): 1 in objects and `wall`, 0 in free space,
        `outside` beyond."""
        return np.where(wall | (self.inside & self.occupied), 1.0, np.where(self.inside, 0.0, outside))


class TouchableSurface(NamedTuple):
    """The part of the truth that can be touched from free space.

    Attributes:
        free: [H, W] bool, empty cells inside the arena.
        wall: [H, W] bool, other cells whose centre is within one cell of a surface that faces a free cell:
            the boundary of objects, and one ring around the arena even if its wall has no thickness.
        points: [K, 2] points on those surfaces, m, one every `SURFACE_SPACING`.
    """

    free: np.ndarray
    wall: np.ndarray
    points: np.ndarray


def cell_centres(grid: OccupancyGrid) -> np.ndarray:
    """The centres [H, W, 2] of the cells, m."""
    height, width = grid.probability.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.asarray(grid.origin) + grid.cell * np.stack([x, y], axis=-1)


def touchable_surface(grid: OccupancyGrid, truth: GridTruth) -> TouchableSurface:
    """The touchable part of the truth, on the cells of the map.

    A surface faces free space where the cell about half or one cell away on either side is free; so the face
    between an object and a wall that it leans on does not count.
    """
    from scipy.spatial import cKDTree

    free = truth.inside & ~truth.occupied
    points, normals = _points(truth.segments)
    faces, (height, width) = np.zeros(len(points), bool), free.shape
    for step in (-_FAR, -_NEAR, _NEAR, _FAR):
        beside = points + step * grid.cell * normals
        column, row = np.floor((beside - grid.origin) / grid.cell).astype(int).T
        known = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        faces[known] |= free[row[known], column[known]]
    points = points[faces]
    if len(points) == 0:
        return TouchableSurface(free, np.zeros_like(free), points)
    away, _ = cKDTree(points).query(cell_centres(grid))
    return TouchableSurface(free, ~free & (away < _SKIN * grid.cell), points)


def mean_grid(grids: Sequence[OccupancyGrid]) -> OccupancyGrid:
    """The mean of maps on the same cells (Fox et al. 2012, Fig. 4)."""
    first = grids[0]
    for grid in grids:
        grid.check()
        same = grid.probability.shape == first.probability.shape and grid.cell == first.cell
        if not same or not np.array_equal(grid.origin, first.origin):
            raise ValueError("maps with different cells; expected the same shape, cell size and origin")
    return first._replace(probability=np.mean([grid.probability for grid in grids], axis=0))


def _points(segments: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points along segments [S, 4] and their unit normals: [K, 2] each."""
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    length = np.hypot(*along.T)
    count = np.ceil(length / SURFACE_SPACING - 1e-6).astype(int)
    row = np.repeat(np.arange(len(segments)), count)
    first = np.repeat(np.cumsum(count) - count, count)
    share = (np.arange(len(row)) - first + 0.5) / count[row]
    normal = np.stack([-along[row, 1], along[row, 0]], axis=1) / length[row, None]
    return start[row] + share[:, None] * along[row], normal
