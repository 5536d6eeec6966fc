"""Tangents, curvature and radius of an outline felt in a plane.

Input are points along an outline, in order, with their covariance, as `track_contact` gives them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

WINDOW = 4e-3
"""Default half width of the window of a tangent, m along the outline."""
MIN_POINTS = 7
"""Least number of points in a window."""
ROUGHNESS = 1e-4
"""Standard deviation of points about a smooth outline beside their own covariance, m."""


class Tangents(NamedTuple):
    """Local parabolas at N points: direction [N] rad modulo half a turn, its standard deviation [N] rad,
    and curvature [N] 1/m."""

    direction: np.ndarray
    sd: np.ndarray
    curvature: np.ndarray


class Circle(NamedTuple):
    """A fitted circle: centre [2] m, radius m, standard deviation of the radius m."""

    centre: np.ndarray
    radius: float
    sd: float


def plane_covariance(covariance: np.ndarray, axes: tuple[int, int] = (0, 1)) -> np.ndarray:
    """The covariance [2N, 2N] of two of the three coordinates of N points, from [3N, 3N]."""
    index = np.ravel([[3 * k + axis for axis in axes] for k in range(len(covariance) // 3)])
    return covariance[np.ix_(index, index)]


def local_tangents(points: np.ndarray, covariance: np.ndarray, window: float = WINDOW) -> Tangents:
    """Weighted fits of a parabola to the points within `window` along the outline, at each point.

    Args:
        points: [N, 2] m, in order. covariance: [2N, 2N] m².
    """
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    rows = []
    for k in range(len(points)):
        near = np.argsort(np.abs(along - along[k]), kind="stable")
        use = near[: max(MIN_POINTS, int((np.abs(along - along[k]) <= window).sum()))]
        rows.append(_parabola(points, covariance, np.sort(use), k))
    direction, sd, curvature = np.array(rows).T
    return Tangents(direction % np.pi, sd, curvature)


def _parabola(
    points: np.ndarray, covariance: np.ndarray, use: np.ndarray, k: int
) -> tuple[float, float, float]:
    """Direction, its standard deviation and curvature at point `k`, from the points `use`."""
    away = points[use] - points[k]
    ahead = np.linalg.svd(away - away.mean(axis=0))[2][0]
    index = np.ravel([[2 * n, 2 * n + 1] for n in use])
    for _ in range(2):  # the second time along the tangent found
        across = np.array([-ahead[1], ahead[0]])
        to_normal = np.kron(np.eye(len(use)), across)
        spread = to_normal @ covariance[np.ix_(index, index)] @ to_normal.T
        spread += ROUGHNESS**2 * np.eye(len(use))
        u = away @ ahead
        design = np.column_stack([np.ones(len(use)), u, u**2 / 2])
        weighted = design.T / np.diag(spread)
        solve = np.linalg.solve(weighted @ design, weighted)
        _, slope, bend = solve @ (away @ across)
        sd = float(np.sqrt((solve @ spread @ solve.T)[1, 1]))
        ahead = (ahead + slope * across) / np.hypot(1.0, slope)
    return float(np.arctan2(ahead[1], ahead[0])), sd, float(bend / (1.0 + slope**2) ** 1.5)


def fit_circle(points: np.ndarray, covariance: np.ndarray) -> Circle:
    """The circle of largest likelihood: distances to it are weighted by the variance across it.

    (An algebraic fit of a short arc with noise gives a radius that is too small; it is only the start.)

    Args:
        points: [N, 2] m. covariance: [2N, 2N] m².
    """
    blocks = np.stack([covariance[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(points))])
    middle = points.mean(axis=0)
    away = points - middle

    def error(circle: np.ndarray) -> np.ndarray:
        ray = away - circle[:2]
        distance = np.linalg.norm(ray, axis=1)
        ahead = ray / distance[:, None]
        variance = np.einsum("ni,nij,nj->n", ahead, blocks, ahead) + ROUGHNESS**2
        return np.asarray((distance - circle[2]) / np.sqrt(variance))

    design = np.column_stack([2 * away, np.ones(len(away))])
    x, y, rest = np.linalg.lstsq(design, (away**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(rest + x**2 + y**2))
    found = least_squares(error, [x, y, radius], x_scale=radius)
    x, y, radius = found.x
    # How the radius answers to the points, with their full covariance.
    ray = away - found.x[:2]
    ahead = ray / np.linalg.norm(ray, axis=1, keepdims=True)
    scale = np.sqrt(np.einsum("ni,nij,nj->n", ahead, blocks, ahead) + ROUGHNESS**2)
    design = -np.column_stack([ahead, np.ones(len(ahead))]) / scale[:, None]
    to_normal = np.zeros((len(points), 2 * len(points)))
    for k, one in enumerate(ahead):
        to_normal[k, 2 * k : 2 * k + 2] = one
    spread = to_normal @ covariance @ to_normal.T + ROUGHNESS**2 * np.eye(len(points))
    solve = np.linalg.solve(design.T @ design, design.T / scale)
    sd = float(np.sqrt((solve @ spread @ solve.T)[2, 2]))
    return Circle(middle + [x, y], float(radius), sd)
