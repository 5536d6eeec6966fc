"""The relaxation of RatSLAM: every link in turn moves both of its ends towards its measurement.

Source: Ball et al. 2013, section 6 (Gauss-Seidel in order of creation, no fixed node, no weights). For
comparison: it needs thousands of sweeps for the result of one solve by `ratslam.mapping`.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin

import numpy as np

from tactile.base.se2 import wrap


def relax(poses: np.ndarray, links: Sequence[np.ndarray], loops: int, correction: float) -> np.ndarray:
    """Poses [N, 3] after `loops` sweeps over the links.

    Args:
        links: [L] of each the nodes at its start and end; distance (m) and direction (rad) of the end in the
            frame of the start; and the heading of the end in that frame, rad.
        correction: share of a link's error by which each end moves.
    """
    # Plain floats: every link depends on the one before, so the loop cannot be vectorised.
    x, y, th = (column.tolist() for column in np.asarray(poses, float).T)
    rows = list(zip(*(column.tolist() for column in links), strict=True))
    for _ in range(loops):
        for a, b, far, aside, turned in rows:
            bearing = th[a] + aside
            ex = correction * (x[b] - (x[a] + far * cos(bearing)))
            ey = correction * (y[b] - (y[a] + far * sin(bearing)))
            eth = correction * _wrap(th[b] - th[a] - turned)
            x[a] += ex
            y[a] += ey
            x[b] -= ex
            y[b] -= ey
            th[a] = _wrap(th[a] + eth)
            th[b] = _wrap(th[b] - eth)
    return np.array([x, y, th]).T.reshape(-1, 3)


def _wrap(angle: float) -> float:
    # Angles already in range stay exact: thousands of sweeps must not accumulate rounding.
    return angle if -pi < angle <= pi else wrap(angle)
