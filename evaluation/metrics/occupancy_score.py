"""The score of an occupancy map: equation 6 of Fox et al. 2012 and `grid_metrics`, as a record and a table.

Other than equation 6, the metrics use only cells that a whisker can observe: free space and the surfaces that
bound it. The inside of objects and the space behind walls cannot be touched; including them would
reward guessing. Chamfer distances measure occupied cells that the map shows there.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from evaluation.metrics.grid_error import (
    CONVENTIONS,
    DISTINCT_CONVENTIONS,
    Convention,
    GridError,
    grid_error,
    pool_errors,
)
from evaluation.metrics.grid_metrics import GRID_METRICS, grid_findings
from evaluation.metrics.metric import Quantity
from evaluation.metrics.occupancy_grid import GridTruth, OccupancyGrid, check_grid, touchable_surface
from tactile.base.settings import Settings

PAPER_ERRORS = {"blob": 0.40, "geometric": 0.39, "template": 0.37}
"""Equation 6 by mapper, as printed (Fox et al. 2012, III, without its convention)."""


class GridScore(Settings):
    """The score of one map, or the mean over several trials."""

    name: str
    """Name of the mapper."""
    trials: int = 1
    """Number of maps; every value is their mean."""
    errors: tuple[GridError, ...]
    """Equation 6, in the order of `evaluation.metrics.grid_error.CONVENTIONS`."""
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
    check_grid(grid, truth)
    surface = touchable_surface(grid, truth)
    findings = grid_findings(grid, truth, surface)
    return GridScore(
        name=name,
        errors=tuple(grid_error(grid, truth, surface, convention) for convention in CONVENTIONS),
        quantities={metric.name: metric.quantity(findings[metric.name]) for metric in GRID_METRICS},
    )


def pool_grids(scores: Sequence[GridScore], name: str) -> GridScore:
    """The mean of the scores of single trials (the score of the mean map would hide half the error)."""
    return GridScore(
        name=name,
        trials=len(scores),
        errors=tuple(pool_errors(each) for each in zip(*(score.errors for score in scores), strict=True)),
        quantities={m.name: _pool([score.quantities[m.name] for score in scores]) for m in GRID_METRICS},
    )


def render_grid_scores(scores: Sequence[GridScore]) -> str:
    """Scores of several mappers as a text table: equation 6 with its baselines, then all other metrics."""
    width = max(len("mapper"), *(len(score.name) for score in scores))
    trials = ", ".join(str(n) for n in sorted({score.trials for score in scores}))
    head = f"{'outside':<9}{'cells':<7}{'truth':<10}{'mapper':<{width + 2}}{'paper':>6}{'ours':>8}{'sd':>8}"
    lines = [
        f"Map error, eq. 6: mean |map - truth| per cell; trials: {trials}",
        head + f"{'constant 0.3':>14}{'best constant':>15}{'skill':>8}",
    ]
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
    lines += [
        f"A random map (fair coin per cell) has error {coin:.3f} for any truth (0.47 in the paper).",
        "",
        " " * 36 + "".join(f"{score.name:>{max(width, 7) + 2}}" for score in scores),
    ]
    for metric in GRID_METRICS:
        values = (_text(score.quantities[metric.name].value) for score in scores)
        cells = "".join(f"{value:>{max(width, 7) + 2}}" for value in values)
        lines.append(f"{metric.label:<36}{cells}  {metric.unit}")
    return "\n".join(line.rstrip() for line in lines)


def _pool(quantities: Sequence[Quantity]) -> Quantity:
    values = [quantity.value for quantity in quantities if quantity.value is not None]
    if not values or len(quantities) == 1:
        return quantities[0]
    without = [quantity.note for quantity in quantities if quantity.value is None]
    parts = [f"sd {np.std(values, ddof=1):.2g}"] if len(values) > 1 else []
    parts += [f"{len(without)} of {len(quantities)} trials without: {without[0]}"] if without else []
    return quantities[0].model_copy(update={"value": float(np.mean(values)), "note": "; ".join(parts)})


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
