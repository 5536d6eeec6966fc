"""Edges of a pose graph and their error functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ratslam.core.compiled import compiled

PI = float(np.pi)


class Edges(NamedTuple):
    """E relative poses measured between nodes.

    Attributes:
        i, j: [E] int, nodes. motion: [E, 3] measured pose of j in the frame of i (m, m, rad).
        information: [E, 3] inverse variances, or [E, 3, 3] inverse covariances.
    """

    i: np.ndarray
    j: np.ndarray
    motion: np.ndarray
    information: np.ndarray


ErrorFunction = Callable[[np.ndarray, Edges], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""Errors [E, 3] of poses [N, 3], and their Jacobians [E, 3, 3] by the poses of i and of j. An error must
depend only on the pose of j in the frame of i."""


def difference_error(poses: np.ndarray, edges: Edges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The error of g2o: the pose of j in the frame of i, minus the measured one, in the measured frame.

    Returns:
        errors [E, 3] and their Jacobians [E, 3, 3] by the poses of i and of j.
    """
    return _differences(poses, edges.i, edges.j, edges.motion)


@compiled
def _differences(
    poses: np.ndarray, i: np.ndarray, j: np.ndarray, motion: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """See `difference_error`."""
    error, by_a, by_b = np.empty((len(i), 3)), np.zeros((len(i), 3, 3)), np.zeros((len(i), 3, 3))
    for e in range(len(i)):
        a, b, (x, y, turn) = poses[i[e]], poses[j[e]], motion[e]
        c, s = np.cos(a[2] + turn), np.sin(a[2] + turn)
        cm, sm = np.cos(turn), np.sin(turn)
        dx, dy = b[0] - a[0], b[1] - a[1]
        ahead, aside = c * dx + s * dy, c * dy - s * dx
        error[e, 0], error[e, 1] = ahead - (cm * x + sm * y), aside - (cm * y - sm * x)
        error[e, 2] = PI - (PI - (b[2] - a[2] - turn)) % (2 * PI)
        by_b[e, 0, 0], by_b[e, 0, 1], by_b[e, 1, 0], by_b[e, 1, 1], by_b[e, 2, 2] = c, s, -s, c, 1.0
        by_a[e] = -by_b[e]
        by_a[e, 0, 2], by_a[e, 1, 2] = aside, -ahead
    return error, by_a, by_b


def logmap_error(poses: np.ndarray, edges: Edges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The error of gtsam: the SE(2) logarithm of `difference_error`."""
    error, by_a, by_b = difference_error(poses, edges)
    angle, x, y = error[:, 2], error[:, 0].copy(), error[:, 1].copy()
    half = angle / 2
    small = np.abs(angle) < 1e-4
    tangent = np.tan(np.where(small, 1.0, half))
    sine = np.sin(np.where(small, 1.0, half))
    scale = np.where(small, 1 - angle**2 / 12, half / tangent)
    slope = np.where(small, -angle / 6, 0.5 / tangent - half / (2 * sine**2))
    outer = np.zeros((len(x), 3, 3))
    outer[:, 0, 0] = outer[:, 1, 1] = scale
    outer[:, 0, 1], outer[:, 1, 0] = half, -half
    outer[:, 0, 2] = slope * x + y / 2
    outer[:, 1, 2] = slope * y - x / 2
    outer[:, 2, 2] = 1.0
    log = np.stack([scale * x + half * y, scale * y - half * x, angle], axis=1)
    return log, outer @ by_a, outer @ by_b


def information_matrices(information: np.ndarray) -> np.ndarray:
    """[E, 3, 3] information in either form as matrices."""
    return information if information.ndim == 3 else information[:, :, None] * np.eye(3)
