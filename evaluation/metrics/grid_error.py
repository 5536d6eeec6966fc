"""Equation 6 of Fox et al. 2012: the mean of |map - truth| over cells, under all of its conventions.

The paper does not specify the truth outside the arena or the cells of the mean, and it smooths the truth; its
values depend on all three. So the error is computed under every convention and compared with constant maps,
some of which have smaller errors.
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
    true = truth_occupancy(truth, surface.wall, convention.outside)
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


def pool_errors(errors: Sequence[GridError]) -> GridError:
    """The mean of the errors of several trials, under the same convention."""
    if len({error.convention for error in errors}) != 1:
        raise ValueError("no errors, or errors under different conventions; expected one convention")
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
