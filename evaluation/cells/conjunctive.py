"""Tuning to place and heading at once.

Sargolini et al. 2006 call a cell conjunctive if its grid score and its mean vector length both lie above the
95th percentile of shuffles: `exceeds_both`. `conjunctive_information` asks the same of any cell, with a grid
or without, in one number: its information about place or about heading, whichever is smaller.

The information of a joint map beyond the two would be the other measure; it fails its control. A path fills
800 joint bins so thinly that shuffled cells have more of it than cells that are tuned to both.
"""

from __future__ import annotations

import numpy as np

from evaluation.cells.information import information


def conjunctive_information(rates: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """[n] the smaller of the information of the place map and of the tuning curve that a joint map contains,
    bits per unit of activity (Skaggs et al. 1993, each).

    0 for a cell that is flat over place or over heading. It takes the joint map because a shuffle must shift
    place and heading together.

    Args:
        rates: [n, B, H, W], NaN where unknown. seconds: [B, H, W] s.
    """
    sums = np.nan_to_num(rates) * seconds
    return np.minimum(_marginal(sums, seconds, (1,)), _marginal(sums, seconds, (2, 3)))


def exceeds_both(
    grid: np.ndarray,
    vector: np.ndarray,
    grid_threshold: np.ndarray | float,
    vector_threshold: np.ndarray | float,
) -> np.ndarray:
    """[n] bool, conjunctive cells of Sargolini et al. 2006.

    Args:
        grid: [n] grid scores. vector: [n] mean vector lengths. grid_threshold, vector_threshold: the 95th
            percentile of their shuffles, of each cell [n] or of all.
    """
    return (grid > grid_threshold) & (vector > vector_threshold)


def _marginal(sums: np.ndarray, seconds: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """[n] information of the map that remains after summing over axes of `sums` [n, B, H, W]."""
    time = seconds.sum(axis=tuple(axis - 1 for axis in axes))
    return information(sums.sum(axis=axes) / np.where(time > 0, time, np.nan), time)
