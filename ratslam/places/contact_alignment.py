"""Aligns contacts of whiskers with those remembered in a map: a pose within a place.

Recall names the place; whisker images vary little over some centimetres and tenths of a radian. The contact
points of several whisks, laid over those of the map's keyframes by point-to-line ICP (Chen & Medioni 1992;
Censi 2008), give the lateral position and the heading that steering in a corridor needs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from tactile.base.se2 import between, compose

THINNED = 0.008
"""Spacing of the remembered points, m."""
AROUND = 0.035
"""Distance within which neighbours give the direction of a wall, m."""
GATE = 0.04
"""Largest distance between a contact and its remembered neighbour, m."""
NEAR = 0.015
"""Distance within which a contact and a remembered one are of the same wall, m."""
SCATTER = 0.006
"""Standard deviation of a contact across a wall, m: half its thickness."""
TRUST = np.array([0.02, 0.02, 0.05])
"""Standard deviation of the pose before (m, m, rad)."""
WORST = 0.05
"""Share of the map's own revisits that agree worse than what still fits."""
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
        self.points = np.stack(sums, axis=1)[count >= 2] / count[count >= 2, None]
        self._tree = cKDTree(self.points)
        self.normals = np.zeros((len(self.points), 2))  # unit vectors across the points around each
        for k, point in enumerate(self.points):
            near = self.points[self._tree.query_ball_point(point, AROUND)]
            self.normals[k] = np.linalg.eigh(np.cov(near.T) if len(near) > 2 else np.eye(2))[1][:, 0]

    def align(self, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        """The pose [3] near a given one from which points [m, 2] in base_link (m) fit best.

        The given pose counts as a measurement with the deviations `TRUST`; with fewer than `FEWEST` points
        near remembered ones it is returned unchanged.
        """
        if len(points) < FEWEST or len(self.points) < FEWEST:
            return pose
        body = _flat(points)
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

    def agreement(self, pose: np.ndarray, points: np.ndarray) -> float:
        """Share of points [m, 2] in base_link (m), seen from a pose [3], within `NEAR` of a remembered one;
        NaN with fewer than `FEWEST` points."""
        if len(points) < FEWEST or len(self.points) < FEWEST:
            return float("nan")
        placed = compose(pose, _flat(points))[:, :2]
        return float((self._tree.query(placed)[0] <= NEAR).mean())


class RememberedContacts:
    """The contacts of a map, and how well its later contacts agree with its earlier ones.

    Args:
        poses: [n, 3] of keyframes in order of time, m, m, rad. points: [m, 2] contacts of each in
            base_link, m. window: number of keyframes whose contacts are compared together.

    Attributes:
        least: agreement below which contacts do not fit: that of the worst `WORST` of the later windows.
    """

    def __init__(self, poses: np.ndarray, points: Sequence[np.ndarray], window: int) -> None:
        self.cloud = ContactCloud(placed_points(poses, points))
        known = len(points) * 2 // 3
        earlier = ContactCloud(placed_points(poses[:known], points[:known]))
        found = []
        for k in range(known + window, len(points), window):
            rows = range(k - window, k)
            seen = [between(poses[k - 1], compose(poses[i], _flat(points[i])))[:, :2] for i in rows]
            together = np.concatenate(seen)
            found.append(earlier.agreement(earlier.align(poses[k - 1], together), together))
        known_ones = np.array(found)[np.isfinite(found)]
        self.least = float(np.quantile(known_ones, WORST)) if len(known_ones) else 0.0

    def align(self, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        """See `ContactCloud.align`."""
        return self.cloud.align(pose, points)

    def agrees(self, pose: np.ndarray, points: np.ndarray) -> bool:
        """Whether points [m, 2] in base_link (m), seen from a pose [3], fit the map as well as its revisits;
        too few points deny nothing."""
        return not self.cloud.agreement(pose, points) < self.least


def _flat(points: np.ndarray) -> np.ndarray:
    return np.column_stack([points, np.zeros(len(points))])


def placed_points(poses: np.ndarray, points: Sequence[np.ndarray]) -> np.ndarray:
    """[n, 2] points of all poses in the map, m."""
    parts = [compose(pose, _flat(seen))[:, :2] for pose, seen in zip(poses, points, strict=True)]
    return np.concatenate([np.zeros((0, 2)), *parts])
