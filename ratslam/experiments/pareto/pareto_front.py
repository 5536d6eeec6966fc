"""Which of several choices are worth making: those that no other betters in all that counts."""

from __future__ import annotations

import numpy as np


def optimal(costs: np.ndarray) -> np.ndarray:
    """[N] bool, the Pareto-optimal ones of costs [N, K], all of them better if smaller: no other is at most
    as dear in everything and cheaper in something. Equal ones are optimal together; one with a NaN is not,
    and stands in nobody's way."""
    known = ~np.isnan(costs).any(axis=1)
    no_dearer = (costs[:, None] <= costs[None]).all(axis=2)
    cheaper = (costs[:, None] < costs[None]).any(axis=2)
    return known & ~(no_dearer & cheaper).any(axis=0)
