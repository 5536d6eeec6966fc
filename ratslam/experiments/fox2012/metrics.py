"""What is measured on one session through one filter: the path, its loops, and the map."""

from __future__ import annotations

import numpy as np

from evaluation.metrics.grid_error import CONVENTIONS, Convention
from evaluation.metrics.grid_score import GridScore
from tactile.base.se2 import wrap

NEAR = 0.1
"""A robot so near to where it was before is there again, m: two cells."""
AWAY = 0.5
"""It must have been so far off in between, m."""
CLOSED = 0.1
"""A loop is closed if the path puts the two visits apart as they are to so much, m."""


def word_of(convention: Convention) -> str:
    """A convention's column: `eq6_grid_raw_0.3`."""
    return f"eq6_{convention.mask}_{'smooth' if convention.smooth else 'raw'}_{convention.outside:g}"


MEASURED = ("told", "final", "heading", "loops", "closed", "gap")
SCORED = (
    "map_brier_skill", "map_brier_skill_free", "map_log_loss", "map_auc", "map_auc_free", "map_chamfer_map",
    "map_chamfer_walls",
)  # fmt: skip
FIELDS = (*MEASURED, "reckoned", *(word_of(each) for each in CONVENTIONS), *SCORED)
"""Columns of figures in NAME.csv."""


def off(path: np.ndarray, truth: np.ndarray) -> float:
    """Mean distance of the positions of poses [T, 3] from the true ones, m, not aligned."""
    return float(np.hypot(*(path - truth)[:, :2].T).mean())


def measured(told: np.ndarray, path: np.ndarray, truth: np.ndarray) -> dict[str, float | None]:
    """Of poses [T, 3] as told at the time, as known in the end and true.

    `told` and `final` are mean errors of position, m; `heading` that of heading as told, degrees; `loops` how
    many reports were made at a place visited before, of which `closed` is the share whose two visits the path
    puts where they belong to each other, and `gap` by how much it misses on average, m.
    """
    again = revisits(truth)
    gap = np.zeros(0)
    if len(again):
        later, earlier = again.T
        gap = np.hypot(*((path[later] - path[earlier]) - (truth[later] - truth[earlier]))[:, :2].T)
    return {
        "told": off(told, truth),
        "final": off(path, truth),
        "heading": float(np.degrees(np.abs(wrap(told[:, 2] - truth[:, 2])).mean())),
        "loops": len(again),
        "closed": float((gap < CLOSED).mean()) if len(gap) else None,
        "gap": float(gap.mean()) if len(gap) else None,
    }


def revisits(truth: np.ndarray) -> np.ndarray:
    """[L, 2] the reports that came back to where an earlier one was, and the nearest of those."""
    found = []
    for k, here in enumerate(truth[:, :2]):
        apart = np.hypot(*(truth[:k, :2] - here).T)
        left = np.flatnonzero(apart > AWAY)
        before = apart[: left[-1]] if len(left) else apart[:0]
        if len(before) and before.min() < NEAR:
            found.append((k, int(before.argmin())))
    return np.array(found, int).reshape(-1, 2)


def scored(score: GridScore) -> dict[str, float | None]:
    """A map's figures by the names of `FIELDS`."""
    errors = {word_of(error.convention): error.error for error in score.errors}
    values = {name: score.quantities[name].value for name in SCORED}
    return errors | {name: None if v is None else float(v) for name, v in values.items()}
