"""Spatial information, sparsity and selectivity of rate maps and tuning curves; conjunctive tuning.

All functions take rates [n, bins...], NaN where unknown, and seconds [bins...], the time in each bin, and
return [n]; a cell without activity has NaN. Bins may be places [H, W], headings [B] or both [B, H, W]. In
formulas p is the share of time in a bin, r the rate there and m = sum p r the mean rate.
"""

from __future__ import annotations

import numpy as np

from evaluation.cells.rate_map import weigh_bins


def information(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] sum p r/m log2(r/m), bits per unit of activity: bits/spike for any scale of the rates.

    Skaggs et al. 1993; pynapple computes the same. opexebo leaves out bins below the mean rate:
    `information_above_mean`.
    """
    relative, share = _relative(rates, seconds)
    return np.vecdot(share, relative * np.log2(np.maximum(relative, np.finfo(float).tiny)))


def information_above_mean(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] `information`, summed over the bins above the mean rate alone; the convention of opexebo."""
    relative, share = _relative(rates, seconds)
    return np.vecdot(share, relative * np.log2(np.maximum(relative, 1.0)))


def information_rate(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] sum p r log2(r/m), bits times the unit of the rates: bits/s for rates in spikes/s. Skaggs et al.
    1993."""
    return information(rates, seconds) * mean_rate(rates, seconds)


def sparsity(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] m^2 / sum p r^2, the share of the box in which the cell is active, in (0, 1]; 1 for a flat map.

    Skaggs et al. 1996.
    """
    relative, share = _relative(rates, seconds)
    return 1 / np.vecdot(share, relative**2)


def selectivity(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] highest rate over mean rate, at least 1. Skaggs et al. 1996."""
    relative, _ = _relative(rates, seconds)
    return relative.max(axis=1)


def mean_rate(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] sum p r, in the unit of the rates."""
    rates, share = weigh_bins(rates, seconds)
    return np.vecdot(share, rates)


def _relative(rates: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rates over their mean [n, bins], NaN for a cell without activity, and the share of time of
    `weigh_bins`."""
    rates, share = weigh_bins(rates, seconds)
    mean = np.vecdot(share, rates)
    return rates / np.where(mean > 0, mean, np.nan)[:, None], share


def conjunctive_information(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] the smaller of the information of the place map and of the tuning curve that a joint map contains,
    bits per unit of activity (Skaggs et al. 1993, each).

    It asks of any cell in one number what Sargolini et al. 2006 ask of grid cells: that grid score and mean
    vector length both lie above the 95th percentile of shuffles; 0 for a cell that is flat over place or over
    heading. It takes the joint map because a shuffle must shift place and heading together.
    The information of a joint map beyond the two fails its control: a path fills 800 joint bins so thinly
    that shuffled cells have more of it than cells that are tuned to both.

    Args:
        rates: [n, B, H, W], NaN where unknown. seconds: [B, H, W] s.
    """
    sums, found = np.nan_to_num(rates) * seconds, []
    for axes in ((1,), (2, 3)):  # the map that remains after summing over heading, or over place
        time = seconds.sum(axis=tuple(axis - 1 for axis in axes))
        found.append(information(sums.sum(axis=axes) / np.where(time > 0, time, np.nan), time))
    return np.minimum(*found)
