"""Tests of the paper's ranking of its mappers, on the same sets and under all ways to score a map.

The paper ranks its mappers by one number. Two baselines show what that number means: the best constant map,
which needs no contact, and the same marks drawn along dead reckoning and along the true path. A ranking that
holds there too is one of the marks, not of the filters.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from evaluation.metrics.grid_error import DISTINCT_CONVENTIONS, Convention
from evaluation.metrics.statistics import bootstrap
from ratslam.experiments.fox2012.protocols import FILTERED, PAPERS, RECKONED, TRUE
from ratslam.experiments.trials.reproduction import ResultRow, column

FEW = 6  # number of sets below which the intervals are too narrow


class Measure(NamedTuple):
    """A way to score a map.

    Attributes:
        key: of `reproduction.FIELDS`. sign: 1 if larger is worse, else -1. trivial: score of a map without
            information, or the convention of which it is the best constant map's.
    """

    name: str
    key: str
    sign: int
    trivial: float | Convention


class Ranking(NamedTuple):
    """The test of the paper's ranking under one measure.

    Attributes:
        steps: for each pair of neighbours from worst to best, the mean difference and its 95 % interval.
            word: `holds`, `does not hold` or `not decided`. beaten: whether a map without information is as
            good as the best mapper.
    """

    steps: tuple[tuple[float, float, float], ...]
    word: str
    beaten: bool


MEASURES = (
    *(
        Measure("eq. 6  {:<5}{:<7}{}".format(*each.words), each.column, 1, each)
        for each in DISTINCT_CONVENTIONS
    ),
    Measure("Brier skill", "map_brier_skill", -1, 0.0),
    Measure("wall AUC", "map_auc", -1, 0.5),
    Measure("Chamfer, map to walls", "map_chamfer_map", 1, 0.0),
    Measure("Chamfer, walls to map", "map_chamfer_walls", 1, 0.0),
)
"""All measures. A map without information wins either Chamfer distance alone: with few cells, or with all."""


def rank_mappers(
    rows: Sequence[ResultRow], method: str, measure: Measure, along: str = FILTERED
) -> Ranking | None:
    """Tests the paper's ranking for a method's marks along a path; None with fewer than two complete sets."""
    score = measure.sign * np.array([column(rows, (method, name, along), measure.key) for name in PAPERS])
    score = score[:, np.isfinite(score).all(axis=0)]
    if score.shape[1] < 2:
        return None
    name = f"{method} {along} {measure.key}"
    steps = tuple((float((a - b).mean()), *bootstrap(a - b, name)) for a, b in pairwise(score))
    holds, fails = all(low > 0 for _, low, _ in steps), any(high <= 0 for *_, high in steps)
    word = "holds" if holds else "does not hold" if fails else "not decided"
    trivial = measure.trivial
    if isinstance(trivial, Convention):
        trivial = float(np.mean([row.session.score.under(trivial).best for row in rows]))
    return Ranking(steps, word, bool(measure.sign * trivial <= score.mean(axis=1).min()))


def render_rankings(method: str, rows: Sequence[ResultRow]) -> list[str]:
    """A line for each measure."""
    first, second, third = PAPERS
    lines = [
        f"{first} worse than {second} worse than {third}? {method}: paired differences, 95 % intervals",
        f"{'scored by':<29}{f'{first} - {second}':<29}{f'{second} - {third}':<29}{'verdict':<15}"
        f"{f'on {RECKONED}':<19}on the {TRUE}",
    ]
    for measure in MEASURES:
        held = rank_mappers(rows, method, measure)
        if held is None:
            lines.append(f"{measure.name:<29}too few sets with a score of all three")
            continue
        steps = "".join(f"{f'{d:+.4f} [{low:+.4f}, {high:+.4f}]':<29}" for d, low, high in held.steps)
        others = (rank_mappers(rows, method, measure, along) for along in (RECKONED, TRUE))
        words = [other.word if other else "-" for other in others]
        beaten = "a map without information is as good" if held.beaten else ""
        lines.append(f"{measure.name:<29}{steps}{held.word:<15}{words[0]:<19}{words[1]:<18}{beaten}".rstrip())
    if len({row.number for row in rows}) < FEW:
        lines.append(f"Intervals of fewer than {FEW} sets are too narrow.")
    return lines
