"""The score of an occupancy map: equation 6 of Fox et al. 2012 and `GRID_METRICS`, as a record and a table.

Equation 6 is the mean of |map - truth| over cells. The paper does not specify the truth outside the arena or
the cells of the mean, and it smooths the truth; its values depend on all three. So the error is computed
under every convention and compared with constant maps, some of which have smaller errors.

The other metrics use only cells that a whisker can observe: free space and the surfaces that bound it. The
inside of objects and the space behind walls cannot be touched; including them would reward guessing. Chamfer
distances measure occupied cells that the map shows there.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product
from typing import Any, Literal

import numpy as np

from evaluation.metrics.metric import Finding, Metric, Quantity
from evaluation.metrics.occupancy_grid import (
    PRIOR_OCCUPANCY,
    GridTruth,
    OccupancyGrid,
    TouchableSurface,
    cell_centres,
    touchable_surface,
)
from evaluation.metrics.statistics import auc
from tactile.base.settings import Settings

CellMask = Literal["grid", "arena"]
"""Cells of the mean: all, or those of the arena and its wall."""
SMOOTH_SD = 2.5
"""Standard deviation of the 5 x 5 Gaussian that smooths the truth, cells (the unit is not in the paper)."""

_TAPS = 2  # cells to either side
_MASKS: tuple[CellMask, ...] = ("grid", "arena")


class Convention(Settings):
    """One reading of equation 6."""

    outside: float = PRIOR_OCCUPANCY
    """Truth outside the arena and its wall."""
    mask: CellMask = "grid"
    """Cells of the mean."""
    smooth: bool = False
    """Whether the truth is smoothed; then a perfect map has an error, and a blurred one a smaller error."""

    @property
    def words(self) -> tuple[str, str, str]:
        """The three settings in words; `any` where the truth outside does not matter."""
        anywhere = self.mask == "arena" and not self.smooth
        outside = "any" if anywhere else f"{self.outside:g}"
        return outside, self.mask, "smoothed" if self.smooth else "raw"

    @property
    def column(self) -> str:
        """The name of a column with the error, e.g. `eq6_grid_raw_0.3`."""
        return f"eq6_{self.mask}_{'smooth' if self.smooth else 'raw'}_{self.outside:g}"


CONVENTIONS = tuple(
    Convention(outside=outside, mask=mask, smooth=smooth)
    for smooth, mask, outside in product((False, True), _MASKS, (PRIOR_OCCUPANCY, 0.0, 1.0))
)
"""All conventions. Within the arena without smoothing, `outside` makes no difference."""
DISTINCT_CONVENTIONS = tuple(
    each for each in CONVENTIONS if each.words[0] != "any" or each == Convention(mask="arena")
)
"""The conventions whose errors can differ."""
MAIN_CONVENTION = Convention()
"""Unknown outside, all cells, not smoothed: false evidence outside counts, and a perfect map scores 0. The
same convention with smoothing is closest to the paper's text."""


class GridError(Settings):
    """Equation 6 under one convention, of the map and of maps without exploration."""

    convention: Convention
    """The convention."""
    error: float
    """Mean of |map - truth|; for several trials the mean of their errors."""
    spread: float | None = None
    """Its standard deviation over trials; None for one."""
    prior: float
    """Error of 0.3 in all cells."""
    best: float
    """Error of the best constant, the median of the truth."""
    coin: float
    """Expected error of a map of Bernoulli(0.5) cells: 0.5 for any truth (the paper prints 0.47)."""
    skill: float | None
    """1 - error / best; None if the best constant has no error."""


def grid_error(
    grid: OccupancyGrid, truth: GridTruth, surface: TouchableSurface, convention: Convention
) -> GridError:
    """The error of one map. `surface` is `occupancy_grid.touchable_surface(grid, truth)`."""
    true = truth.occupancy(surface.wall, convention.outside)
    true = smooth_truth(true) if convention.smooth else true
    cells = truth.inside | surface.wall if convention.mask == "arena" else np.ones_like(truth.inside)
    if not cells.any():
        raise ValueError("truth without arena cells; expected at least one")
    true, ours = true[cells], grid.probability[cells]
    error, best = _mean(np.abs(ours - true)), _mean(np.abs(np.median(true) - true))
    return GridError(
        convention=convention,
        error=error,
        prior=_mean(np.abs(PRIOR_OCCUPANCY - true)),
        best=best,
        coin=_mean(0.5 * np.abs(true) + 0.5 * np.abs(1 - true)),
        skill=_skill(error, best),
    )


def smooth_truth(values: np.ndarray) -> np.ndarray:
    """Applies the 5 x 5 Gaussian of `SMOOTH_SD` to [H, W], with edge cells repeated outwards."""
    from scipy.ndimage import correlate1d

    taps = np.exp(-(np.arange(-_TAPS, _TAPS + 1) ** 2) / (2 * SMOOTH_SD**2))
    for axis in (0, 1):
        values = correlate1d(values, taps / taps.sum(), axis=axis, mode="nearest")
    return values


def _mean(values: Sequence[float] | np.ndarray) -> float:
    return float(np.mean(values))


def _skill(error: float, best: float) -> float | None:
    return 1 - error / best if best > 0 else None


OCCUPIED_ABOVE = 0.5
"""Cells above this probability count as occupied (Chamfer)."""
CLAMP = 1e-3
"""Probabilities are clipped to this distance from 0 and 1 before the logarithm."""

_ROUNDING = 6  # decimals; closer probabilities tie


GRID_METRICS: tuple[Metric, ...] = (
    Metric("map_brier", "Brier score", "", "low", "Map"),
    Metric("map_brier_skill", "Brier skill", "", "high", "Map"),
    Metric("map_brier_skill_free", "  with free space alone", "", "high", "Map"),
    Metric("map_log_loss", "log loss", "nat", "low", "Map"),
    Metric("map_log_loss_constant", "  of the best constant", "nat", None, "Map"),
    Metric("map_auc", "wall AUC", "", "high", "Map"),
    Metric("map_auc_free", "  with free space alone", "", "high", "Map"),
    Metric("map_chamfer_map", "Chamfer, occupied cells to walls", "m", "low", "Map"),
    Metric("map_chamfer_walls", "Chamfer, walls to occupied cells", "m", "low", "Map"),
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
    driven, clipped = np.minimum(ours, PRIOR_OCCUPANCY), "the map clipped at its prior"
    rate = float(wall.mean())
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


PAPER_ERRORS = {"blob": 0.40, "geometric": 0.39, "template": 0.37}
"""Equation 6 by mapper, as printed (Fox et al. 2012, III, without its convention)."""


class GridScore(Settings):
    """The score of one map, or the mean over several trials."""

    name: str
    """Name of the mapper."""
    trials: int = 1
    """Number of maps; every value is their mean."""
    errors: tuple[GridError, ...]
    """Equation 6, in the order of `evaluation.metrics.occupancy_score.CONVENTIONS`."""
    quantities: dict[str, Quantity]
    """In the order of the table; an undefined value is None with a reason."""

    def under(self, convention: Convention) -> GridError:
        """Equation 6 under one convention."""
        return next(error for error in self.errors if error.convention == convention)


def score_grid(grid: OccupancyGrid, truth: GridTruth, name: str = "map") -> GridScore:
    """Scores one map in the frame of the truth, without alignment.

    Raises:
        ValueError: the map is invalid or not on the cells of the truth.
    """
    grid.check(truth)
    surface = touchable_surface(grid, truth)
    findings = _cells(grid, surface) | _chamfer(grid, truth, surface)
    errors = tuple(grid_error(grid, truth, surface, convention) for convention in CONVENTIONS)
    quantities = {metric.name: metric.quantity(findings[metric.name]) for metric in GRID_METRICS}
    return GridScore(name=name, errors=errors, quantities=quantities)


def pool_grids(scores: Sequence[GridScore], name: str) -> GridScore:
    """The mean of the scores of single trials (the score of the mean map would hide half the error)."""
    errors = []
    for trials in zip(*(score.errors for score in scores), strict=True):  # under the same convention
        every = {part: [getattr(one, part) for one in trials] for part in ("error", "prior", "best", "coin")}
        means: dict[str, Any] = {part: _mean(values) for part, values in every.items()}
        means["spread"] = float(np.std(every["error"], ddof=1)) if len(trials) > 1 else None
        means["skill"] = _skill(means["error"], means["best"])
        errors.append(trials[0].model_copy(update=means))
    names = [metric.name for metric in GRID_METRICS]
    quantities = {one: Quantity.pool([score.quantities[one] for score in scores]) for one in names}
    return GridScore(name=name, trials=len(scores), errors=tuple(errors), quantities=quantities)


def render_grid_scores(scores: Sequence[GridScore]) -> str:
    """Scores of several mappers as a text table: equation 6 with its baselines, then all other metrics."""
    width = max(len("mapper"), *(len(score.name) for score in scores))
    trials = ", ".join(str(n) for n in sorted({score.trials for score in scores}))
    head = f"{'outside':<9}{'cells':<7}{'truth':<10}{'mapper':<{width + 2}}{'paper':>6}{'ours':>8}{'sd':>8}"
    title = f"Map error, eq. 6: mean |map - truth| per cell; trials: {trials}"
    lines = [title, head + f"{'constant 0.3':>14}{'best constant':>15}{'skill':>8}"]
    for convention in DISTINCT_CONVENTIONS:
        outside, cells, truth = convention.words
        label = f"{outside:<9}{cells:<7}{truth:<10}"
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
    random = f"A random map (fair coin per cell) has error {coin:.3f} for any truth (0.47 in the paper)."
    names = "".join(f"{score.name:>{max(width, 7) + 2}}" for score in scores)
    lines += [random, "", " " * 36 + names]
    for metric in GRID_METRICS:
        values = (_text(score.quantities[metric.name].value) for score in scores)
        cells = "".join(f"{value:>{max(width, 7) + 2}}" for value in values)
        lines.append(f"{metric.label:<36}{cells}  {metric.unit}")
    return "\n".join(line.rstrip() for line in lines)


def _order(scores: Sequence[GridScore], convention: Convention) -> list[str]:
    """The paper's mappers by decreasing error, compared with the paper's order."""
    known = [score for score in scores if score.name in PAPER_ERRORS]
    errors = {score.name: (score.under(convention), score.trials) for score in known}
    if len(errors) < 2:
        return []
    names = sorted(errors, key=lambda name: -errors[name][0].error)
    same = names == sorted(names, key=lambda name: -PAPER_ERRORS[name])
    verdict = "as in the paper" if same else "not the paper's"
    close = [
        f"{a} and {b}"
        for a, b in pairwise(names)
        if errors[a][0].error - errors[b][0].error < np.hypot(_standard(*errors[a]), _standard(*errors[b]))
    ]
    apart = f"; within a standard error: {', '.join(close)}" if close else ""
    return [f"order: {' > '.join(names)}, {verdict}{apart}"]


def _standard(error: GridError, trials: int) -> float:
    """Standard error of a mean over trials; 0 for one trial."""
    return (error.spread or 0.0) / np.sqrt(trials)


def _text(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
