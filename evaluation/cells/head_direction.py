"""Tuning to heading: mean vector, preferred direction, Rayleigh test.

Functions take tuning curves [n, B], NaN where unknown (`rate_map.tuning_curves`), and seconds [B], and
return [n]. Bin b is centred on 2 pi b / B. Curves are divided by the time at each heading, so uneven
sampling of headings alone gives no tuning.
"""

from __future__ import annotations

import numpy as np

from evaluation.cells.rate_map import weigh_bins


def mean_vector_length(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] |sum r exp(i angle)| / sum r, in [0, 1]: 0 without tuning, 1 for a single heading; NaN without
    activity.

    Zar 1999, ch. 26, without the correction for the width of bins, as opexebo.
    """
    return np.abs(_mean_vector(rates, seconds))


def preferred_direction(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] direction of the mean vector, rad in [0, 2 pi).

    opexebo counts angles from the edge of the first bin and not from its centre: half a bin, pi / B, more.
    """
    return np.angle(_mean_vector(rates, seconds)) % (2 * np.pi)


def peak_rate(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] highest rate at any heading or place, in the unit of the rates."""
    filled, _ = weigh_bins(rates, seconds)
    return filled.max(axis=1)


def rayleigh_z(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] z = N r^2 with r the mean vector length and N = sum rate x seconds the number of spikes (Zar 1999,
    eq. 27.2).

    Rates must be in spikes/s: N decides.
    """
    return _spikes(rates, seconds) * mean_vector_length(rates, seconds) ** 2


def rayleigh_p(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] probability of so long a mean vector for N spikes at headings drawn evenly and independently.

    exp(sqrt(1 + 4 N + 4 (N^2 - R^2)) - 1 - 2 N) with R = N r (Zar 1999, p. 617; `circ_rtest` of Berens
    2009). Successive spikes of a cell are not independent, so it is far too small as a test of one cell;
    compare with shuffles. Rates in spikes/s.
    """
    count = _spikes(rates, seconds)
    squared = (count * mean_vector_length(rates, seconds)) ** 2
    return np.minimum(np.exp(np.sqrt(1 + 4 * count + 4 * (count**2 - squared)) - (1 + 2 * count)), 1.0)


def _mean_vector(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] complex."""
    filled, _ = weigh_bins(rates, seconds)
    total = filled.sum(axis=1)
    bins = filled.shape[1]
    unit = np.exp(2j * np.pi * np.arange(bins) / bins)
    return filled @ unit * (1 / np.where(total > 0, total, np.nan))


def _spikes(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    return np.nan_to_num(rates) @ seconds
