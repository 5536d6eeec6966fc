"""Metrics of an occupancy map on the cells that whiskers can observe: free space and reachable surfaces."""

from __future__ import annotations

import numpy as np

from evaluation.metrics.metric import Direction, Finding, Metric
from evaluation.metrics.occupancy_grid import (
    PRIOR_OCCUPANCY,
    GridTruth,
    OccupancyGrid,
    TouchableSurface,
    cell_centres,
)
from evaluation.metrics.statistics import auc

OCCUPIED_ABOVE = 0.5
"""Cells above this probability count as occupied (Chamfer)."""
CLAMP = 1e-3
"""Probabilities are clipped to this distance from 0 and 1 before the logarithm."""

_ROUNDING = 6  # decimals; closer probabilities tie


def grid_findings(grid: OccupancyGrid, truth: GridTruth, surface: TouchableSurface) -> dict[str, Finding]:
    """The findings of `GRID_METRICS` by name."""
    return _cells(grid, surface) | _chamfer(grid, truth, surface)


def _metric(name: str, label: str, unit: str, direction: Direction) -> Metric:
    return Metric(name, label, unit, direction, "Map", lambda findings: findings[name])


GRID_METRICS: tuple[Metric, ...] = (
    _metric("map_brier", "Brier score", "", "low"),
    _metric("map_brier_skill", "Brier skill", "", "high"),
    _metric("map_brier_skill_free", "  with free space alone", "", "high"),
    _metric("map_log_loss", "log loss", "nat", "low"),
    _metric("map_log_loss_constant", "  of the best constant", "nat", None),
    _metric("map_auc", "wall AUC", "", "high"),
    _metric("map_auc_free", "  with free space alone", "", "high"),
    _metric("map_chamfer_map", "Chamfer, occupied cells to walls", "m", "low"),
    _metric("map_chamfer_walls", "Chamfer, walls to occupied cells", "m", "low"),
)
"""In the order of the table."""


def _cells(grid: OccupancyGrid, surface: TouchableSurface) -> dict[str, Finding]:
    """Scores of the separation of walls from free space.

    Much of a map's skill comes from the free space along the robot's path, for which no whisker is needed. So
    each score is also given for the map clipped at its prior, which leaves free space only (`_free`).
    """
    cells = surface.free | surface.wall
    wall, ours = surface.wall[cells], grid.probability[cells]
    if wall.all() or not wall.any():
        reason = f"the truth has no {'wall' if surface.free.any() else 'free space'}"
        names = [metric.name for metric in GRID_METRICS if "chamfer" not in metric.name]
        return dict.fromkeys(names, Finding(np.nan, note=reason))
    driven, rate, clipped = (
        np.minimum(ours, PRIOR_OCCUPANCY),
        float(wall.mean()),
        "the map clipped at its prior",
    )
    blind, loss = rate * (1 - rate), _log_loss(np.full(len(wall), rate), wall)
    return {
        "map_brier": Finding(_brier(ours, wall), note=f"best constant, {rate:.3g}: {blind:.4g}"),
        "map_brier_skill": Finding(1 - _brier(ours, wall) / blind, note="against the best constant"),
        "map_brier_skill_free": Finding(1 - _brier(driven, wall) / blind, note=clipped),
        "map_log_loss": Finding(_log_loss(ours, wall), note=f"clamped at {CLAMP:g}"),
        "map_log_loss_constant": Finding(loss, note=f"{rate:.3g} everywhere"),
        "map_auc": Finding(_auc(ours, wall), note=f"{wall.sum()} wall and {(~wall).sum()} free cells"),
        "map_auc_free": Finding(_auc(driven, wall), note=clipped),
    }


def _brier(ours: np.ndarray, wall: np.ndarray) -> float:
    return float(np.mean((ours - wall) ** 2))


def _log_loss(ours: np.ndarray, wall: np.ndarray) -> float:
    """Mean negative logarithm of the probability of the true state, nat."""
    clipped = np.clip(ours, CLAMP, 1 - CLAMP)
    return float(-np.mean(np.log(np.where(wall, clipped, 1 - clipped))))


def _auc(ours: np.ndarray, wall: np.ndarray) -> float:
    """Share of (wall cell, free cell) pairs in which the wall cell is more probable; ties count half."""
    rounded = np.round(ours, _ROUNDING)
    return auc(rounded[~wall], rounded[wall])


def _chamfer(grid: OccupancyGrid, truth: GridTruth, surface: TouchableSurface) -> dict[str, Finding]:
    """Mean distances between the centres of cells mapped as occupied and the true surfaces, both ways.

    One way alone can be minimised by a single correct cell or by marking all cells. Cells inside objects,
    below their surface, are ignored. A perfect map scores half a cell one way and slightly more the other.
    """
    from scipy.spatial import cKDTree

    deep = truth.inside & truth.occupied & ~surface.wall
    drawn = (grid.probability > OCCUPIED_ABOVE) & ~deep
    if len(surface.points) and drawn.any():
        cells = cell_centres(grid)[drawn]
        to_walls, to_cells = cKDTree(surface.points).query(cells)[0], cKDTree(cells).query(surface.points)[0]
        note = f"{len(cells)} cells above {OCCUPIED_ABOVE:g}"
        return {
            "map_chamfer_map": Finding(float(to_walls.mean()), note=note),
            "map_chamfer_walls": Finding(float(to_cells.mean()), note=f"{len(surface.points)} points"),
        }
    reason = f"no cell above {OCCUPIED_ABOVE:g}" if len(surface.points) else "the truth has no wall"
    return dict.fromkeys(("map_chamfer_map", "map_chamfer_walls"), Finding(np.nan, note=reason))
