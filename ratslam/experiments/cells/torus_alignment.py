"""How well the maps of all cells in one box fit those in another after one turn and shift on the torus."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import fft

_FLAT = 1e-12
"""A variance below this share of the mean square is rounding: the map is flat."""


class Alignment(NamedTuple):
    """The turn and shift common to all cells at which the mean correlation of their maps is highest.

    Attributes:
        angle: of the second box, rad anticlockwise. shift: (x, y) added afterwards, bins, from 0 to below the
            bins of the torus. correlation: [C] of each cell there; NaN where one of its maps is flat.
    """

    angle: float
    shift: tuple[int, int]
    correlation: np.ndarray


def align_maps(first: np.ndarray, second: np.ndarray, bins: int, angles: Sequence[float]) -> Alignment:
    """The best common turn and shift of the second maps onto the first.

    Args:
        first, second: [C, H, W] rates, NaN where unknown; bins of one size. bins: along a side of the torus,
            in bins of the maps: shifts wrap round it. angles: to try, rad.
    """
    laid = lay_on_torus(first, bins, 0.0)
    best = Alignment(np.nan, (0, 0), np.full(len(first), -np.inf))
    for angle in angles:
        fits = correlate_shifts(laid, lay_on_torus(second, bins, angle))
        known = np.isfinite(fits)
        mean = np.where(known, fits, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        y, x = np.unravel_index(mean.argmax(), mean.shape)
        if mean[y, x] > mean_correlation(best.correlation):
            best = Alignment(float(angle), (int(x), int(y)), fits[:, y, x])
    return best


def mean_correlation(correlation: np.ndarray) -> float:
    """Mean over the cells [C] that have one; NaN if none has."""
    known = correlation[~np.isnan(correlation)]
    return float(known.mean()) if known.size else np.nan


def lay_on_torus(maps: np.ndarray, bins: int, angle: float) -> np.ndarray:
    """[C, N, N] maps [C, H, W] turned round the middle of the box and laid on a torus of N bins a side.

    Each bin goes to the nearest bin of the torus; the mean is taken where several meet, NaN where none.
    """
    height, width = maps.shape[1:]
    y, x = (np.mgrid[:height, :width].reshape(2, -1).T - [(height - 1) / 2, (width - 1) / 2]).T
    column = np.cos(angle) * x - np.sin(angle) * y + (width - 1) / 2
    row = np.sin(angle) * x + np.cos(angle) * y + (height - 1) / 2
    at = np.round(row).astype(int) % bins * bins + np.round(column).astype(int) % bins
    flat = maps.reshape(len(maps), -1)
    known = np.isfinite(flat)
    sums, count = (np.zeros((len(maps), bins * bins)) for _ in range(2))
    for cell in range(len(maps)):
        sums[cell] = np.bincount(at[known[cell]], flat[cell, known[cell]], bins * bins)
        count[cell] = np.bincount(at[known[cell]], minlength=bins * bins)
    return (sums / np.where(count > 0, count, np.nan)).reshape(-1, bins, bins)


def correlate_shifts(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[C, N, N] Pearson correlations of maps on a torus [C, N, N] with others shifted by (y, x) bins.

    The bins that both maps have take part; NaN where one of them is flat there.
    """
    f, g = fft.rfft2(_parts(first)), fft.rfft2(_parts(second))
    side = first.shape[-2:]

    def sums(a: int, b: int) -> np.ndarray:
        return fft.irfft2(f[a] * np.conj(g[b]), side)

    count = np.maximum(np.round(sums(0, 0)), 1)
    mean, shifted_mean = sums(1, 0) / count, sums(0, 1) / count
    square, shifted_square = sums(2, 0) / count, sums(0, 2) / count
    variance, shifted_variance = square - mean**2, shifted_square - shifted_mean**2
    flat = (variance <= _FLAT * square) | (shifted_variance <= _FLAT * shifted_square)
    product = np.where(flat, np.nan, variance * shifted_variance)
    return np.clip((sums(1, 1) / count - mean * shifted_mean) / np.sqrt(product), -1.0, 1.0)


def _parts(maps: np.ndarray) -> np.ndarray:
    """[3, C, N, N] mask, values and squares, of maps scaled to a peak of 1."""
    known = np.isfinite(maps)
    values = np.where(known, maps, 0.0)
    peak = np.abs(values).max(axis=(1, 2), keepdims=True)
    values = values / np.where(peak > 0, peak, 1.0)
    return np.array([known.astype(float), values, values**2])
