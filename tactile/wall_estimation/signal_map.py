"""The signals of a whisker as a function of the place of contact, learned from a calibration on a stage.

A stage moves a contact to known positions in the whisker's frame and records the signals there. The map is a
Gaussian process (Rasmussen and Williams 2006, ch. 2): a Matérn kernel of order 5/2 on top of a linear trend,
one for all channels, over direction and distance from the whisker's base, in which signals vary evenly (in
Cartesian coordinates they vary much faster near the base).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from tactile.base.errors import InputError

MIN_ROWS = 20
"""Least number of calibration rows."""
MAX_FITTED_ROWS = 300
"""Rows from which length scale and noise are chosen; the map itself uses all rows."""
TREND = 10.0
"""Standard deviation of the linear trend, in those of the process."""
MAX_MISFIT = 6.0
"""A row whose leave-one-out error exceeds this many of its standard deviations is left out."""
SHARE_FLOOR = 0.1
"""Least size of signals to which noise is proportional, as a share of the median size."""
LEAST, MOST = (0.1, 0.1, 1e-3), (5.0, 20.0, 1.0)
"""Limits of the length scales (rad; spreads of the distance from the base) and of the noise."""
OUTLIER_ROUNDS = 3
"""Rounds of leaving rows out."""

SignalMap = Callable[[np.ndarray], np.ndarray]
"""The signals [M, C] expected of contacts at positions [M, 3], m."""


def fit_signal_map(position: np.ndarray, signal: np.ndarray, base: np.ndarray) -> SignalMap:
    """Learns the map; length scales and noise are the most likely ones.

    Rows that contradict their neighbours, as where a whisker slips off, are left out.

    Args:
        position: [N, 3] contact positions, m, none of them at the base. signal: [N, C] signals above
            baseline, in any unit. base: [3] the whisker's base in the same frame, m.

    Raises:
        InputError: too few rows, or positions or signals that do not vary.
    """
    if len(position) < MIN_ROWS:
        raise InputError("calibration", f"{len(position)} rows", f"at least {MIN_ROWS}")
    reach = np.linalg.norm(position - base, axis=1)
    if not (reach > 0).all() or not reach.std() > 0 or not (signal.std(axis=0) > 0).all():
        raise InputError("calibration", "positions or signals that do not vary", "a sweep of positions")
    offset, scale = signal.mean(axis=0), signal.std(axis=0)
    size = np.linalg.norm(signal, axis=1) / np.linalg.norm(scale)
    share = np.maximum(size, SHARE_FLOOR * np.median(size))
    value, away = (signal - offset) / scale, position - base
    use = np.ones(len(value), bool)
    for _ in range(OUTLIER_ROUNDS):
        length, noise = _most_likely(away[use], value[use], share[use])
        where = _features(away, length)
        factor = _factor(where[use], noise * share[use])
        # The largest leave-one-out error over the channels, in the usual one or in standard deviations, the
        # larger (Rasmussen and Williams 2006, eq. 5.12).
        weight = cho_solve((factor, True), value[use])
        variance = 1.0 / np.diag(cho_solve((factor, True), np.eye(len(weight))))
        amplitude = np.sqrt((value[use] * weight).mean(axis=0))
        error = np.abs(weight * np.sqrt(variance)[:, None] / amplitude).max(axis=1)
        error = np.asarray(error / max(1.0, float(np.median(error))))
        if not (error > MAX_MISFIT).any():
            break
        use[np.flatnonzero(use)[error > MAX_MISFIT]] = False
    factor = _factor(where[use], noise * share[use])
    weight = cho_solve((factor, True), value[use])
    amplitude = np.sqrt((value[use] * weight).mean(axis=0))
    # Amplitudes belong to the scale of the signals: weights are those of a process of variance 1.
    scale, weight = scale * amplitude, weight / amplitude
    known = _features(position[use] - base, length)

    def predict(position: np.ndarray) -> np.ndarray:
        between = _covariance(_features(position - base, length), known)
        return np.asarray(offset + scale * (between @ weight))

    return predict


def _features(away: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Direction and distance [N, 4] in length scales, of positions relative to the base [N, 3]."""
    reach = np.linalg.norm(away, axis=1, keepdims=True)
    return np.hstack([away / reach / length[0], reach / length[1]])


def _covariance(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    distance = np.sqrt(5.0) * cdist(one, other)
    return (1.0 + distance + distance**2 / 3.0) * np.exp(-distance) + TREND**2 * (1.0 + one @ other.T)


def _factor(where: np.ndarray, noise: np.ndarray) -> np.ndarray:
    return np.asarray(cholesky(_covariance(where, where) + np.diag(noise**2), lower=True))


def _most_likely(away: np.ndarray, value: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, float]:
    """Length scales and noise of largest marginal likelihood; the amplitude of each channel is its best."""
    some = np.unique(np.linspace(0, len(value) - 1, MAX_FITTED_ROWS).astype(int))
    away, value, share = away[some], value[some], share[some]
    reach = float(np.linalg.norm(away, axis=1).std())

    def unpack(logs: np.ndarray) -> tuple[np.ndarray, float]:
        turn, along, noise = np.exp(np.clip(logs, np.log(LEAST), np.log(MOST)))
        return np.array([turn, along * reach]), float(noise)

    def cost(logs: np.ndarray) -> float:
        length, noise = unpack(logs)
        factor = _factor(_features(away, length), noise * share)
        power = (value * cho_solve((factor, True), value)).mean(axis=0)
        each = 0.5 * len(value) * np.log(power) + np.log(np.diag(factor)).sum()
        return float(each.sum())

    start = np.log([1.0, 1.0, 0.02])
    corners = start + np.vstack([np.zeros(3), 0.5 * np.eye(3)])
    options = {"initial_simplex": corners, "maxiter": 80, "xatol": 0.02, "fatol": 0.1}
    return unpack(minimize(cost, start, method="Nelder-Mead", options=options).x)
