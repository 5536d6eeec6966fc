"""Intervals of means and of rates over runs; separation of two samples; calibration; Pareto-optimal rows."""

from __future__ import annotations

import numpy as np

from tactile.base.random_streams import stream


def bootstrap(values: np.ndarray, name: str, *, seed: int = 0) -> tuple[float, float]:
    """95 % percentile interval of the mean of `values` [R] over 10 000 resamples; NaN without runs.

    Args:
        name: of the random stream; with `seed` it determines the draws.
    """
    if len(values) == 0:
        return np.nan, np.nan
    means = values[stream(seed, name).integers(0, len(values), (10_000, len(values)))].mean(axis=1)
    low, high = np.quantile(means, [(1 - 0.95) / 2, (1 + 0.95) / 2])
    return float(low), float(high)


def wilson_interval(count: int, runs: int) -> tuple[float, float]:
    """95 % interval of a rate of which `count` of `runs` were found (Wilson 1927); (0, 1) without runs."""
    if not runs:
        return 0.0, 1.0
    z = 1.959963984540054
    share, scale = count / runs, 1 + z * z / runs
    centre = share + z * z / (2 * runs)
    half = z * np.sqrt(share * (1 - share) / runs + z * z / (4 * runs * runs))
    low, high = float((centre - half) / scale), float((centre + half) / scale)
    return max(0.0, min(low, share)), min(1.0, max(high, share))  # exact at 0 and 1, without rounding


def auc(low: np.ndarray, high: np.ndarray) -> float:
    """The probability that one of `high` [M] exceeds one of `low` [N], ties counted half."""
    from scipy.stats import rankdata

    rank = rankdata(np.concatenate([high, low]))
    count = len(high)
    return float((rank[:count].sum() - count * (count + 1) / 2) / (count * len(low)))


def expected_calibration_error(probability: np.ndarray, true: np.ndarray, bins: int = 10) -> float:
    """Mean distance between probabilities [N] and the share of them that is `true` [N] bool, over `bins` bins
    of equally many (Naeini et al. 2015); NaN without any."""
    order = np.argsort(probability, kind="stable")
    parts = [part for part in np.array_split(order, bins) if len(part)]
    gaps = [len(part) * abs(probability[part].mean() - true[part].mean()) for part in parts]
    return float(sum(gaps) / len(order)) if parts else float("nan")


def pareto_optimal(costs: np.ndarray) -> np.ndarray:
    """[N] whether a row of costs [N, K] is Pareto-optimal: no other is at most equal in all and less in one.

    Equal rows are optimal together. A row with a NaN is not optimal and dominates no other.
    """
    known = ~np.isnan(costs).any(axis=1)
    no_dearer = (costs[:, None] <= costs[None]).all(axis=2)
    cheaper = (costs[:, None] < costs[None]).any(axis=2)
    return known & ~(no_dearer & cheaper).any(axis=0)
