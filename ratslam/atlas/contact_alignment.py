"""Aligns contacts of whiskers with those remembered in a map: a pose within a place.

Recall names the place; whisker images vary little over some centimetres and tenths of a radian. The contact
points of several whisks, laid over those of the map's keyframes by point-to-line ICP (Chen & Medioni 1992;
Censi 2008), give the lateral position and the heading that steering in a corridor needs.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from tactile.base.se2 import compose

THINNED = 0.008
"""Spacing of the remembered points, m."""
AROUND = 0.035
"""Distance within which neighbours give the direction of a wall, m."""
GATE = 0.04
"""Largest distance between a contact and its remembered neighbour, m."""
SCATTER = 0.006
"""Standard deviation of a contact across a wall, m: half its thickness."""
TRUST = np.array([0.02, 0.02, 0.05])
"""Standard deviation of the pose before (m, m, rad)."""
FEWEST = 6
"""Least number of contacts with a neighbour."""
ITERATIONS = 8


class ContactCloud:
    """Contact points of a map with the direction across the wall at each.

    Args:
        points: [n, 2] in the map, m.
    """

    def __init__(self, points: np.ndarray) -> None:
        cells, cell = np.unique(np.floor(points / THINNED).astype(int), axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        count = np.bincount(cell, minlength=len(cells))
        sums = [np.bincount(cell, points[:, k], minlength=len(cells)) for k in range(2)]
        thin = np.stack(sums, axis=1)[count >= 2] / count[count >= 2, None]
        self.points = thin if len(thin) else np.zeros((0, 2))
        self._tree = cKDTree(self.points)
        self.normals = np.array([self._normal(k) for k in range(len(self.points))]).reshape(-1, 2)

    def align(self, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        """The pose [3] near a given one from which points [m, 2] in base_link (m) fit best.

        The given pose counts as a measurement with the deviations `TRUST`; with fewer than `FEWEST` points
        near remembered ones it is returned unchanged.
        """
        if len(points) < FEWEST or len(self.points) < FEWEST:
            return pose
        body = np.column_stack([points, np.zeros(len(points))])
        moved = np.zeros(3)
        prior = np.diag((SCATTER / TRUST) ** 2)
        for _ in range(ITERATIONS):
            here = pose + moved
            placed = compose(here, body)[:, :2]
            far, near = self._tree.query(placed)
            found = far < GATE
            if found.sum() < FEWEST:
                return pose
            normal, arm = self.normals[near[found]], placed[found] - here[:2]
            off = (normal * (placed[found] - self.points[near[found]])).sum(axis=1)
            turn = normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]
            slope = np.column_stack([normal, turn])
            weight = 1 / (1 + (off / SCATTER) ** 2)  # Cauchy
            normal_matrix = slope.T @ (weight[:, None] * slope) + prior
            step = np.linalg.solve(normal_matrix, -slope.T @ (weight * off) - prior @ moved)
            moved = moved + step
            if np.abs(step).max() < 1e-5:
                break
        return compose(pose + moved, np.zeros(3))

    def _normal(self, k: int) -> np.ndarray:
        """Unit vector across the points around a point."""
        near = self.points[self._tree.query_ball_point(self.points[k], AROUND)]
        _, vectors = np.linalg.eigh(np.cov(near.T) if len(near) > 2 else np.eye(2))
        return vectors[:, 0]
