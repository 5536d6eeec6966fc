"""Equation 6 of Fox et al. 2012: the mean of |map - truth| over cells, under every way to read it.

The paper leaves open what the truth is outside the arena and over which cells is averaged, and it smooths the
truth; its figures turn on all three. So the error is computed under every convention, and beside maps that
nobody had to explore for, some of which win.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Literal

import numpy as np

from evaluation.metrics.occupancy_grid import (
    PRIOR_OCCUPANCY,
    GridTruth,
    OccupancyGrid,
    TouchableSurface,
    truth_occupancy,
)
from tactile.base.config import Settings

CellMask = Literal["grid", "arena"]
"""Over which cells is averaged: all, or the arena's and its wall's."""
SMOOTH_SD = 2.5
"""Of the 5 x 5 Gaussian that smooths the truth, cells: the paper gives no unit, but its filter in cells."""

_TAPS = 2  # cells to either side
_MASKS: tuple[CellMask, ...] = ("grid", "arena")


class Convention(Settings):
    """One reading of equation 6."""

    outside: float = PRIOR_OCCUPANCY
    """What the truth is outside the arena and its wall."""
    mask: CellMask = "grid"
    """Over which cells is averaged."""
    smooth: bool = False
    """Whether the truth is smoothed. Then even a perfect map errs, and a blurred one errs less."""


CONVENTIONS = tuple(
    Convention(outside=outside, mask=mask, smooth=smooth)
    for smooth, mask, outside in product((False, True), _MASKS, (PRIOR_OCCUPANCY, 0.0, 1.0))
)
"""All of them. Within the arena, raw, `outside` makes no difference."""
MAIN_CONVENTION = Convention()
"""Unknown outside, all cells, raw: what a lost robot draws out there costs, and a perfect map scores 0."""
PAPER_CONVENTION = Convention(smooth=True)
"""Nearest to the paper's words."""


class GridError(Settings):
    """Equation 6 under one convention: of the map, and of maps that nobody had to explore for."""

    convention: Convention
    """The reading."""
    error: float
    """Mean of |map - truth|; of several trials the mean of their errors."""
    spread: float | None = None
    """Its standard deviation over trials; None for one."""
    prior: float
    """The error of 0.3 everywhere."""
    best: float
    """The error of the best constant: the median of the truth."""
    coin: float
    """The error of a map of Bernoulli(0.5) cells, in expectation: 0.5 for any truth, not the printed 0.47."""
    skill: float | None
    """1 - error / best; None where the best constant is right everywhere."""


def grid_error(
    grid: OccupancyGrid, truth: GridTruth, felt: TouchableSurface, convention: Convention = MAIN_CONVENTION
) -> GridError:
    """The error of one map. `felt` is `evaluation.metrics.occupancy_grid.touchable_surface(grid, truth)`."""
    true = truth_occupancy(truth, felt.wall, convention.outside)
    true = smooth_truth(true) if convention.smooth else true
    cells = truth.inside | felt.wall if convention.mask == "arena" else np.ones_like(truth.inside)
    if not cells.any():
        raise ValueError("a truth without an arena")
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


def pool_errors(errors: Sequence[GridError]) -> GridError:
    """The mean of the errors of several trials, under the same convention."""
    if len({error.convention for error in errors}) != 1:
        raise ValueError("errors under different conventions, or none")
    every = [error.error for error in errors]
    error, best = _mean(every), _mean([each.best for each in errors])
    return GridError(
        convention=errors[0].convention,
        error=error,
        spread=float(np.std(every, ddof=1)) if len(every) > 1 else None,
        prior=_mean([each.prior for each in errors]),
        best=best,
        coin=_mean([each.coin for each in errors]),
        skill=_skill(error, best),
    )


def smooth_truth(values: np.ndarray) -> np.ndarray:
    """[H, W] after the 5 x 5 Gaussian of `SMOOTH_SD`; beyond its edges the outermost cells go on."""
    from scipy.ndimage import correlate1d

    taps = np.exp(-(np.arange(-_TAPS, _TAPS + 1) ** 2) / (2 * SMOOTH_SD**2))
    for axis in (0, 1):
        values = correlate1d(values, taps / taps.sum(), axis=axis, mode="nearest")
    return values


def _mean(values: Sequence[float] | np.ndarray) -> float:
    return float(np.mean(values))


def _skill(error: float, best: float) -> float | None:
    return 1 - error / best if best > 0 else None
