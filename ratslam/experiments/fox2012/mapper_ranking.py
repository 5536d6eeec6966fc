"""The order of the paper's mappers, held against the same sets under every way to score a map.

The paper ranks its mappers by one number. What that is worth is told by a constant, for which nobody had to
touch anything, and by the same marks drawn along dead reckoning and along the true path: an order that holds
there too is one of marks, not of filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from evaluation.metrics.experience_metric import bootstrap
from evaluation.metrics.grid_error import CONVENTIONS, Convention
from ratslam.experiments.fox2012.metrics import word_of
from ratslam.experiments.fox2012.protocols import FILTERED, PAPERS, RECKONED, TRUE
from ratslam.experiments.fox2012.trials import Result

FEW = 6
"""Sets under which intervals are too narrow."""


class Measure(NamedTuple):
    """A way to score a map.

    Attributes:
        key: of `figures.FIELDS`. sign: 1 where more is worse, -1 where it is better. trivial: what a map gets
            that knows nothing of the place; None for the best constant under `convention`.
    """

    name: str
    key: str
    sign: int
    trivial: float | None = None
    convention: Convention | None = None


class Order(NamedTuple):
    """Two neighbours after the other in the paper's order, from the worst to the best.

    Attributes:
        steps: by how much the first is worse: mean, low and high end of the 95 % interval. word: `holds`,
            `does not hold` or `not decided`. beaten: whether a map that knows nothing is as good as the best.
    """

    steps: tuple[tuple[float, float, float], ...]
    word: str
    beaten: bool


def _measures() -> tuple[Measure, ...]:
    found = []
    for convention in CONVENTIONS:
        if convention.mask == "arena" and not convention.smooth:
            if convention != Convention(mask="arena"):
                continue  # what is outside makes no difference
            outside = "any"
        else:
            outside = f"{convention.outside:g}"
        truth = "smoothed" if convention.smooth else "raw"
        name = f"eq. 6  {outside:<5}{convention.mask:<7}{truth}"
        found.append(Measure(name, word_of(convention), 1, None, convention))
    return (
        *found,
        Measure("Brier skill", "map_brier_skill", -1, 0.0),
        Measure("wall AUC", "map_auc", -1, 0.5),
        Measure("Chamfer, map to walls", "map_chamfer_map", 1, 0.0),
        Measure("Chamfer, walls to map", "map_chamfer_walls", 1, 0.0),
    )


MEASURES = _measures()
"""All ways. Each Chamfer alone is won by a map that knows nothing: by hardly any cell, or by all."""


def order(found: Sequence[Result], method: str, measure: Measure, along: str = FILTERED) -> Order | None:
    """Whether the paper's order holds for a method's marks along a path; None with less than two sets in
    which all have a score."""
    score = measure.sign * np.array([_column(found, (method, name, along), measure.key) for name in PAPERS])
    score = score[:, np.isfinite(score).all(axis=0)]
    if score.shape[1] < 2:
        return None
    name = f"{method} {along} {measure.key}"
    steps = tuple((float((a - b).mean()), *bootstrap(a - b, name)) for a, b in pairwise(score))
    if all(low > 0 for _, low, _ in steps):
        word = "holds"
    elif any(high <= 0 for *_, high in steps):
        word = "does not hold"
    else:
        word = "not decided"
    trivial = measure.trivial
    if trivial is None and measure.convention is not None:
        trivial = float(np.mean([one.score.under(measure.convention).best for one in found]))
    best = float(score.mean(axis=1).min())
    return Order(steps, word, trivial is not None and measure.sign * trivial <= best)


def orders(method: str, found: Sequence[Result]) -> list[str]:
    """A line for each measure."""
    first, second, third = PAPERS
    lines = [
        f"{first} worse than {second} worse than {third}? {method}: by how much, mean and 95 %, paired",
        f"{'scored by':<29}{f'{first} - {second}':<29}{f'{second} - {third}':<29}{'verdict':<15}"
        f"{f'on {RECKONED}':<19}on the {TRUE}",
    ]
    for measure in MEASURES:
        held = order(found, method, measure)
        if held is None:
            lines.append(f"{measure.name:<29}too few sets in which all three have one")
            continue
        steps = "".join(f"{f'{d:+.4f} [{low:+.4f}, {high:+.4f}]':<29}" for d, low, high in held.steps)
        others = (order(found, method, measure, along) for along in (RECKONED, TRUE))
        words = [other.word if other else "-" for other in others]
        beaten = "a map that knows nothing is as good" if held.beaten else ""
        lines.append(f"{measure.name:<29}{steps}{held.word:<15}{words[0]:<19}{words[1]:<18}{beaten}".rstrip())
    if len({one.number for one in found}) < FEW:
        lines.append(f"Intervals of less than {FEW} sets are too narrow.")
    return lines


def _column(found: Sequence[Result], which: tuple[str, str, str], key: str) -> np.ndarray:
    """[S] a figure of a method, a mapper and a path over the sets, NaN where a set is missing."""
    values = np.full(1 + max(one.number for one in found), np.nan)
    for one in found:
        value = one.values.get(key)
        if (one.method, one.mapper, one.along) == which and value is not None:
            values[one.number] = value
    return values
