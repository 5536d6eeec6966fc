"""Coherence of rate maps: how well the rate in a bin is foretold by its neighbours."""

from __future__ import annotations

import numpy as np


def coherence(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] z-transformed correlation of the rate of a bin with the mean rate of its 8 neighbours.

    Muller & Kubie 1989. For maps that were not smoothed: smoothing makes neighbours alike. Bins without a
    rate do not count, and beside a wall the mean is over the neighbours inside. opexebo instead counts
    neighbours outside as 0 and gives the correlation itself: `correlate(rates, neighbour_means(padded)[:,
    1:-1, 1:-1])` with `padded` = rates within a frame of zeros. NaN for a flat map.

    Args:
        rates: [n, H, W], NaN where unknown. seconds: [H, W] s, not used: every bin counts alike.
    """
    correlation = correlate(rates, neighbour_means(rates))
    return np.arctanh(np.clip(correlation, -1 + 1e-15, 1 - 1e-15))


def neighbour_means(rates: np.ndarray) -> np.ndarray:
    """[n, H, W] mean rate of the up to 8 neighbours that have one, NaN without."""
    known = np.isfinite(rates)
    count = _sum_neighbours(known.astype(float))
    total = _sum_neighbours(np.where(known, rates, 0.0))
    return total / np.where(count > 0, count, np.nan)


def correlate(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] Pearson correlation of maps a and b [n, ...] over the bins in which both are known, NaN if one is
    flat."""
    a, b = (values.reshape(len(values), -1) for values in (a, b))
    known = np.isfinite(a) & np.isfinite(b)
    count = np.maximum(known.sum(axis=1, keepdims=True), 1)
    a, b = (np.where(known, values, 0.0) for values in (a, b))
    a, b = (np.where(known, values - values.sum(axis=1, keepdims=True) / count, 0.0) for values in (a, b))
    power = (a * a).sum(axis=1) * (b * b).sum(axis=1)
    return (a * b).sum(axis=1) / np.sqrt(np.where(power > 0, power, np.nan))


def _sum_neighbours(values: np.ndarray) -> np.ndarray:
    """[n, H, W] sum over the 8 neighbours."""
    height, width = values.shape[-2:]
    return _band(height) @ values @ _band(width) - values


def _band(bins: int) -> np.ndarray:
    """[bins, bins] 1 for bins at most one apart."""
    return np.eye(bins) + np.eye(bins, k=1) + np.eye(bins, k=-1)
