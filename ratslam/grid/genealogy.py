"""The genealogy of particles: the paths of the ancestors of the particles that survived.

Memory is bounded: of more than `MAX_POSES` poses, the older half is replaced by the weighted mean path.
"""

from __future__ import annotations

import numpy as np

from ratslam.core.checkpoint import Checkpointed
from ratslam.core.growable_array import GrowableArray

MAX_POSES = 4_000_000
"""Poses stored for individual particles."""


class Genealogy(Checkpointed):
    """Poses and ancestors of N particles at each report."""

    VALUES = ("_weight",)

    def __init__(self, count: int) -> None:
        self.count = count
        self._settled = GrowableArray((3,), np.float64)
        self._ancestor = GrowableArray((count,), np.int32)
        self._pose = GrowableArray((count, 3), np.float64)
        self._weight = np.full(count, 1.0 / count)

    def __len__(self) -> int:
        return len(self._settled.rows) + len(self._pose.rows)

    def append(self, poses: np.ndarray, weights: np.ndarray, ancestor: np.ndarray) -> None:
        """Adds a report: poses [N, 3], normalised weights [N], and the next ancestors [N]."""
        self._pose.append(poses)
        self._ancestor.append(ancestor)
        self._weight = np.asarray(weights, float)
        if len(self._pose.rows) * self.count > MAX_POSES and len(self._pose.rows) > 1:
            self._settle(len(self._pose.rows) // 2)

    def path(self) -> np.ndarray:
        """[T, 3] the weighted mean of the ancestral paths of the present particles."""
        return np.concatenate([self._settled.rows, self._mean_path()])

    def _mean_path(self) -> np.ndarray:
        pose, ancestor = self._pose.rows, self._ancestor.rows
        path = np.zeros((len(pose), 3))
        here = np.arange(self.count)
        for k in range(len(pose) - 1, -1, -1):
            if k + 1 < len(pose):
                here = ancestor[k][here]
            path[k] = _mean(pose[k][here], self._weight)
        return path

    def _settle(self, reports: int) -> None:
        for pose in self._mean_path()[:reports]:
            self._settled.append(pose)
        self._pose.replace(self._pose.rows[reports:].copy())
        self._ancestor.replace(self._ancestor.rows[reports:].copy())


def _mean(pose: np.ndarray, weight: np.ndarray) -> np.ndarray:
    heading = np.arctan2(weight @ np.sin(pose[:, 2]), weight @ np.cos(pose[:, 2]))
    return np.array([*(weight @ pose[:, :2]), heading])
