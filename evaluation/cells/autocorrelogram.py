"""Spatial autocorrelograms of rate maps: the Pearson correlation of a map with its shifted self.

    r(lag) = (n Σ f g - Σ f Σ g) / sqrt((n Σ f² - (Σ f)²) (n Σ g² - (Σ g)²)),   g(x) = f(x + lag)

over the n bins that both maps have at that lag (Sargolini et al. 2006, Science 312:758, supplement). Large
lags have few common bins and are noise; they are cut as in opexebo (`analysis.autocorrelation`).
"""

from __future__ import annotations

import numpy as np
from scipy import fft

from tactile.base.errors import InputError

_OVERLAP = 0.8
"""Kept lags reach this share of the side of the map, as in opexebo."""
_FLAT = 1e-12
"""A variance below this share of the variance of the map is rounding: the map is flat there."""
_BATCH = 64
"""Maps of one batch: its arrays fit the cache."""


def autocorrelogram(rates: np.ndarray) -> np.ndarray:
    """Spatial autocorrelograms of maps, by FFT.

    Args:
        rates: [n, H, W] any unit, NaN in bins without visits. These bins take no part; opexebo takes them as
            0 instead: `autocorrelogram(np.nan_to_num(rates))` equals it.

    Returns:
        [n, h, w] Pearson correlation at the lags -(h // 2) .. h // 2 and -(w // 2) .. w // 2 bins (35 x 35
        for 20 x 20 bins); the centre is lag 0. 0 where the common bins are flat in one of the two maps (as in
        opexebo), NaN where the common bins are fewer than a full map has at the largest kept lags, and NaN
        everywhere for a map that is flat or has no visits.

    Raises:
        InputError: the array is no batch of maps or has no bins.
    """
    rates = np.asarray(rates, float)
    if rates.ndim != 3 or 0 in rates.shape[1:]:
        raise InputError("rates", f"array of shape {list(rates.shape)}", "maps [n, H, W] with bins")
    reach = [_reach(side) for side in rates.shape[1:]]
    maps = np.empty((len(rates), 2 * reach[0] + 1, 2 * reach[1] + 1))
    for start in range(0, len(rates), _BATCH):
        batch = slice(start, start + _BATCH)
        visited = np.isfinite(rates[batch])
        values, flat = _standardise(rates[batch], visited)
        maps[batch] = _correlate(values, visited, reach)
        maps[batch][flat] = np.nan
    return maps


def _standardise(rates: np.ndarray, visited: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maps [n, H, W] of mean 0 and mean square 1, 0 without visits; which of them are flat [n]."""
    count = np.maximum(visited.sum(axis=(1, 2)), 1)[:, None, None]
    filled = np.where(visited, rates, 0.0)
    values = np.where(visited, filled - filled.sum(axis=(1, 2), keepdims=True) / count, 0.0)
    scale = np.sqrt((values**2).sum(axis=(1, 2), keepdims=True) / count)
    flat = scale <= _FLAT * np.abs(filled).max(axis=(1, 2), keepdims=True)
    return values / np.where(flat, 1.0, scale), flat[:, 0, 0]


def _reach(side: int) -> int:
    """Largest kept lag for a side of so many bins; there are at most 1.8 times as many kept lags as bins."""
    return (int(np.round(side + side * _OVERLAP)) - 1) // 2


def _correlate(values: np.ndarray, visited: np.ndarray, reach: list[int]) -> np.ndarray:
    """Correlations [n, h, w] at the kept lags."""
    height, width = values.shape[1:]
    size = (fft.next_fast_len(height + reach[0], real=True), fft.next_fast_len(width + reach[1], real=True))

    def correlate(left: np.ndarray, right: np.ndarray) -> np.ndarray:
        lags = fft.irfft2(np.conj(left) * right, size)
        lags = np.concatenate([lags[:, size[0] - reach[0] :], lags[:, : reach[0] + 1]], axis=1)
        return np.concatenate([lags[:, :, size[1] - reach[1] :], lags[:, :, : reach[1] + 1]], axis=2)

    mask = (visited[:1] if (visited == visited[:1]).all() else visited).astype(float)
    of_mask, of_values, of_squares = (fft.rfft2(part, size) for part in (mask, values, values**2))
    common = np.round(correlate(of_mask, of_mask))
    total = correlate(of_mask, of_values)
    variance = common * correlate(of_mask, of_squares) - total**2
    product = common * correlate(of_values, of_values) - total * total[:, ::-1, ::-1]
    flat = variance <= _FLAT * common * height * width
    deviation = np.sqrt(np.where(flat, np.inf, variance))
    enough = common >= (height - reach[0]) * (width - reach[1])
    return np.where(enough, product / deviation / deviation[:, ::-1, ::-1], np.nan)
