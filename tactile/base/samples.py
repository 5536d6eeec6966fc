"""Small figures of samples: spread without outliers, runs of true values."""

from __future__ import annotations

import numpy as np


def robust_sd(deviation: np.ndarray) -> np.ndarray:
    """The standard deviation [...] of normally distributed deviations [N, ...] about zero, from the median of
    their sizes (Rousseeuw & Croux 1993): outliers, up to half of them, change it little."""
    return np.asarray(1.4826 * np.median(np.abs(deviation), axis=0))


def true_runs(which: np.ndarray) -> np.ndarray:
    """[R, 2] first index and end (exclusive) of each run of true values of [N] bool, in order."""
    edges = np.diff(np.concatenate([[False], which, [False]]).astype(np.int8))
    return np.flatnonzero(edges).reshape(-1, 2)
