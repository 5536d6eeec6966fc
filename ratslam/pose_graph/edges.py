"""Edges of a pose graph and their error functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tactile.base.se2 import wrap


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
    a, b, motion = poses[edges.i], poses[edges.j], edges.motion
    angle = a[:, 2] + motion[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    dx, dy = (b - a)[:, 0], (b - a)[:, 1]
    cm, sm = np.cos(motion[:, 2]), np.sin(motion[:, 2])
    error = np.empty((len(a), 3))
    error[:, 0] = c * dx + s * dy - cm * motion[:, 0] - sm * motion[:, 1]
    error[:, 1] = c * dy - s * dx - cm * motion[:, 1] + sm * motion[:, 0]
    error[:, 2] = wrap(b[:, 2] - a[:, 2] - motion[:, 2])
    by_a, by_b = np.zeros((2, len(a), 3, 3))
    by_b[:, 0, 0], by_b[:, 0, 1], by_b[:, 1, 0], by_b[:, 1, 1], by_b[:, 2, 2] = c, s, -s, c, 1.0
    by_a[:] = -by_b
    by_a[:, 0, 2] = c * dy - s * dx
    by_a[:, 1, 2] = -c * dx - s * dy
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


def information_diagonals(information: np.ndarray) -> np.ndarray:
    """[E, 3] the diagonals of information in either form."""
    return information if information.ndim == 2 else np.diagonal(information, axis1=1, axis2=2)


def information_matrices(information: np.ndarray) -> np.ndarray:
    """[E, 3, 3] information in either form as matrices."""
    return information if information.ndim == 3 else information[:, :, None] * np.eye(3)
