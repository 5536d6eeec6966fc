"""All that is measured on an occupancy map, in one record for a program and one table for a reader.

Beside equation 6 stand scores over the cells that a whisker can tell: free space, and the skin of what bounds
it. The inside of objects and what lies beyond the walls cannot be felt; counted in, they would reward whoever
guesses them. What is drawn out there all the same is told by Chamfer.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from evaluation.metrics.grid_error import CONVENTIONS, Convention, GridError, grid_error, pool_errors
from evaluation.metrics.occupancy_grid import (
    PRIOR_OCCUPANCY,
    GridTruth,
    OccupancyGrid,
    TouchableSurface,
    cell_centres,
    check_grid,
    has_evidence,
    touchable_surface,
)
from evaluation.metrics.scorecard import Quantity
from tactile.base.config import Settings

CLAMP = 1e-3
"""Probabilities are kept so far from 0 and 1 before their logarithm is taken."""
OCCUPIED_ABOVE = 0.5
"""A cell above is drawn as occupied, for Chamfer."""
PAPER_ERRORS = {"blob": 0.40, "geometric": 0.39, "template": 0.37}
"""Equation 6 by mapper, as printed (Fox et al. 2012, III); it does not say under which convention."""

_ROUNDING = 6  # decimals; closer probabilities tie
_QUANTITIES = {
    "map_brier": ("Brier score", ""),
    "map_brier_skill": ("Brier skill", ""),
    "map_brier_skill_free": ("  with free space alone", ""),
    "map_log_loss": ("log loss", "nat"),
    "map_log_loss_constant": ("  of the best constant", "nat"),
    "map_auc": ("wall AUC", ""),
    "map_auc_free": ("  with free space alone", ""),
    "map_chamfer_map": ("Chamfer, occupied cells to walls", "m"),
    "map_chamfer_walls": ("Chamfer, walls to occupied cells", "m"),
}

_Findings = dict[str, tuple[float, str]]


class GridScore(Settings):
    """All that is measured on one map, or on the maps of several trials."""

    name: str
    """What was scored."""
    trials: int = 1
    """So many maps; every value is the mean of theirs."""
    errors: tuple[GridError, ...]
    """Equation 6, in the order of `evaluation.metrics.grid_error.CONVENTIONS`."""
    quantities: dict[str, Quantity]
    """In the order of the table; a value is None where there is none, with a reason."""

    def under(self, convention: Convention) -> GridError:
        """Equation 6 under one convention."""
        return next(error for error in self.errors if error.convention == convention)


def score_grid(
    grid: OccupancyGrid,
    truth: GridTruth,
    name: str = "map",
    *,
    prior: float = PRIOR_OCCUPANCY,
    occupied: float = OCCUPIED_ABOVE,
) -> GridScore:
    """Scores one map where it lies: in the frame of the truth, not aligned to it.

    Args:
        prior: of cells without evidence. occupied: above this a cell is drawn as occupied.

    Raises:
        ValueError: no map, or not on the cells of the truth.
    """
    check_grid(grid, truth)
    felt = touchable_surface(grid, truth)
    found = _cells(grid, felt, prior) | _chamfer(grid, truth, felt, prior, occupied)
    return GridScore(
        name=name,
        errors=tuple(grid_error(grid, truth, felt, convention) for convention in CONVENTIONS),
        quantities={key: _quantity(key, *found[key]) for key in _QUANTITIES},
    )


def pool_grids(scores: Sequence[GridScore], name: str) -> GridScore:
    """The mean of the scores of single trials (not the score of the mean map, which hides half the error)."""
    return GridScore(
        name=name,
        trials=len(scores),
        errors=tuple(pool_errors(each) for each in zip(*(score.errors for score in scores), strict=True)),
        quantities={key: _pooled([score.quantities[key] for score in scores]) for key in _QUANTITIES},
    )


def render_grid_scores(scores: Sequence[GridScore]) -> str:
    """Scores of several mappers as plain text: equation 6 beside its baselines, then everything else."""
    width = max(len("mapper"), *(len(score.name) for score in scores))
    trials = ", ".join(str(n) for n in sorted({score.trials for score in scores}))
    head = f"{'outside':<9}{'cells':<7}{'truth':<10}{'mapper':<{width + 2}}{'paper':>6}{'ours':>8}{'sd':>8}"
    lines = [
        f"Map error, eq. 6: mean |map - truth| a cell; trials: {trials}",
        head + f"{'constant 0.3':>14}{'best constant':>15}{'skill':>8}",
    ]
    for convention in CONVENTIONS:
        anywhere = convention.mask == "arena" and not convention.smooth
        if anywhere and convention.outside != PRIOR_OCCUPANCY:
            continue
        words = "any" if anywhere else f"{convention.outside:g}"
        label = f"{words:<9}{convention.mask:<7}{'smoothed' if convention.smooth else 'raw':<10}"
        for score in scores:
            error = score.under(convention)
            printed, spread = _text(PAPER_ERRORS.get(score.name), 2), _text(error.spread)
            lines.append(
                f"{label}{score.name:<{width + 2}}{printed:>6}{_text(error.error):>8}{spread:>8}"
                f"{_text(error.prior):>14}{_text(error.best):>15}{_text(error.skill, 2):>8}"
            )
            label = " " * len(label)
        lines += [label + order for order in _order(scores, convention)] + [""]
    coin = scores[0].errors[0].coin
    lines += [
        f"A coin for each cell scores {coin:.3f} in expectation for any truth (the paper prints 0.47).",
        "",
        " " * 36 + "".join(f"{score.name:>{max(width, 7) + 2}}" for score in scores),
    ]
    for key, (label, unit) in _QUANTITIES.items():
        values = (_text(score.quantities[key].value) for score in scores)
        lines.append(f"{label:<36}" + "".join(f"{v:>{max(width, 7) + 2}}" for v in values) + f"  {unit}")
    return "\n".join(line.rstrip() for line in lines)


def _cells(grid: OccupancyGrid, felt: TouchableSurface, prior: float) -> _Findings:
    """How well walls are told from free space.

    Much of a map's skill comes from where the robot drove, for which no whisker is needed. So a score stands
    beside that of the same map cut off at its prior: with its free space alone.
    """
    cells = felt.free | felt.wall
    wall, ours = felt.wall[cells], grid.probability[cells]
    if wall.all() or not wall.any():
        reason = f"the truth has no {'wall' if felt.free.any() else 'free space'}"
        return {key: (np.nan, reason) for key in _QUANTITIES if "chamfer" not in key}
    driven, rate = np.minimum(ours, prior), float(wall.mean())
    blind, loss = rate * (1 - rate), _log_loss(np.full(len(wall), rate), wall)
    return {
        "map_brier": (_brier(ours, wall), f"best constant, {rate:.3g}: {blind:.4g}"),
        "map_brier_skill": (1 - _brier(ours, wall) / blind, "against the best constant"),
        "map_brier_skill_free": (1 - _brier(driven, wall) / blind, "the map cut off at its prior"),
        "map_log_loss": (_log_loss(ours, wall), f"clamped at {CLAMP:g}"),
        "map_log_loss_constant": (loss, f"{rate:.3g} everywhere"),
        "map_auc": (_auc(ours, wall), f"{wall.sum()} wall and {(~wall).sum()} free cells"),
        "map_auc_free": (_auc(driven, wall), "the map cut off at its prior"),
    }


def _brier(ours: np.ndarray, wall: np.ndarray) -> float:
    return float(np.mean((ours - wall) ** 2))


def _log_loss(ours: np.ndarray, wall: np.ndarray) -> float:
    """-log of the probability given to what is there, nats."""
    kept = np.clip(ours, CLAMP, 1 - CLAMP)
    return float(-np.mean(np.log(np.where(wall, kept, 1 - kept))))


def _auc(ours: np.ndarray, wall: np.ndarray) -> float:
    """The share of pairs of a wall and a free cell of which the wall is the likelier occupied; ties half."""
    from scipy.stats import rankdata

    walls, free = int(wall.sum()), int((~wall).sum())
    rank = rankdata(np.round(ours, _ROUNDING))
    return float((rank[wall].sum() - walls * (walls + 1) / 2) / (walls * free))


def _chamfer(
    grid: OccupancyGrid, truth: GridTruth, felt: TouchableSurface, prior: float, occupied: float
) -> _Findings:
    """Mean distances between the centres of cells that the map draws as occupied and the true surfaces.

    Each way alone can be won: by one right cell, or by drawing all cells. Cells within objects, deeper than
    their skin, neither help nor harm. A perfect map has half a cell one way and a little more the other.
    """
    from scipy.spatial import cKDTree

    deep = truth.inside & truth.occupied & ~felt.wall
    drawn = (grid.probability > occupied) & has_evidence(grid, prior) & ~deep
    if len(felt.points) and drawn.any():
        cells = cell_centres(grid)[drawn]
        to_walls, to_cells = cKDTree(felt.points).query(cells)[0], cKDTree(cells).query(felt.points)[0]
        note = f"{len(cells)} cells above {occupied:g}"
        return {
            "map_chamfer_map": (float(to_walls.mean()), note),
            "map_chamfer_walls": (float(to_cells.mean()), f"{len(felt.points)} points"),
        }
    reason = f"no cell above {occupied:g}" if len(felt.points) else "the truth has no wall"
    return dict.fromkeys(("map_chamfer_map", "map_chamfer_walls"), (np.nan, reason))


def _quantity(key: str, value: float, note: str) -> Quantity:
    label, unit = _QUANTITIES[key]
    return Quantity(label=label, value=value if np.isfinite(value) else None, unit=unit, note=note)


def _pooled(quantities: Sequence[Quantity]) -> Quantity:
    values = [quantity.value for quantity in quantities if quantity.value is not None]
    if not values or len(quantities) == 1:
        return quantities[0]
    without = [quantity.note for quantity in quantities if quantity.value is None]
    parts = [f"sd {np.std(values, ddof=1):.2g}"] if len(values) > 1 else []
    parts += [f"{len(without)} of {len(quantities)} trials without: {without[0]}"] if without else []
    return quantities[0].model_copy(update={"value": float(np.mean(values)), "note": "; ".join(parts)})


def _order(scores: Sequence[GridScore], convention: Convention) -> list[str]:
    """The paper's mappers from the largest error to the smallest, and whether that is the paper's order."""
    errors = {
        score.name: (score.under(convention), score.trials) for score in scores if score.name in PAPER_ERRORS
    }
    if len(errors) < 2:
        return []
    names = sorted(errors, key=lambda name: -errors[name][0].error)
    verdict = (
        "as in the paper"
        if names == sorted(names, key=lambda name: -PAPER_ERRORS[name])
        else "not the paper's"
    )
    close = [
        f"{a} and {b}"
        for a, b in pairwise(names)
        if errors[a][0].error - errors[b][0].error < np.hypot(_standard(*errors[a]), _standard(*errors[b]))
    ]
    apart = f"; within a standard error: {', '.join(close)}" if close else ""
    return [f"order: {' > '.join(names)}, {verdict}{apart}"]


def _standard(error: GridError, trials: int) -> float:
    """The standard error of a mean over trials; 0 for one trial, of which nothing is known."""
    return (error.spread or 0.0) / np.sqrt(trials)


def _text(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
