"""Where the ancestors of particles have been: the paths of those that survived.

Memory is bounded: what lies further back than `LEVELS` poses' worth of reports is settled as the mean of the
paths that lead there.
"""

from __future__ import annotations

import numpy as np

from ratslam.core.growable_array import GrowableArray

LEVELS = 4_000_000
"""Poses kept of reports that may still be told apart."""


class Ancestry:
    """Poses of N particles and whom they descend from, report by report."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._settled = GrowableArray((3,), np.float64)
        self._ancestor = GrowableArray((count,), np.int32)
        self._pose = GrowableArray((count, 3), np.float64)
        self._weight = np.full(count, 1.0 / count)

    def __len__(self) -> int:
        return len(self._settled.rows) + len(self._pose.rows)

    def append(self, poses: np.ndarray, weights: np.ndarray, ancestor: np.ndarray) -> None:
        """A report: poses [N, 3] and shares [N], and [N] of whom each particle is a copy from now on."""
        self._pose.append(poses)
        self._ancestor.append(ancestor)
        self._weight = np.asarray(weights, float)
        if len(self._pose.rows) * self.count > LEVELS and len(self._pose.rows) > 1:
            self._settle(len(self._pose.rows) // 2)

    def path(self) -> np.ndarray:
        """[T, 3] the weighted mean of the paths that lead to where the particles are now."""
        return np.concatenate([self._settled.rows, self._followed()])

    def _followed(self) -> np.ndarray:
        pose, ancestor = self._pose.rows, self._ancestor.rows
        path = np.zeros((len(pose), 3))
        here = np.arange(self.count)
        for k in range(len(pose) - 1, -1, -1):
            if k + 1 < len(pose):
                here = ancestor[k][here]
            path[k] = _mean(pose[k][here], self._weight)
        return path

    def _settle(self, reports: int) -> None:
        for pose in self._followed()[:reports]:
            self._settled.append(pose)
        self._pose.replace(self._pose.rows[reports:].copy())
        self._ancestor.replace(self._ancestor.rows[reports:].copy())

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything, so that `restore` continues bit for bit."""
        return {
            "settled": self._settled.rows.copy(),
            "ancestor": self._ancestor.rows.copy(),
            "pose": self._pose.rows.copy(),
            "weight": self._weight.copy(),
        }

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Takes the place of everything so far."""
        self._settled.replace(arrays["settled"])
        self._ancestor.replace(arrays["ancestor"])
        self._pose.replace(arrays["pose"])
        self._weight = np.array(arrays["weight"], float)


def _mean(pose: np.ndarray, weight: np.ndarray) -> np.ndarray:
    heading = np.arctan2(weight @ np.sin(pose[:, 2]), weight @ np.cos(pose[:, 2]))
    return np.array([*(weight @ pose[:, :2]), heading])
