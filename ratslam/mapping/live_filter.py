"""Where the newest keyframe is between two optimisations of the map.

An optimisation costs time that grows with the map, so it does not follow every closure. In between, a
Kalman filter moves the newest keyframe by the odometry, and corrects it by every closure of an accepted
sequence; the matched keyframes count as known. The next optimisation replaces the pose. Source: Thrun,
Burgard & Fox 2005, table 7.2 (extended Kalman filter with known correspondences).
"""

from __future__ import annotations

import numpy as np

from ratslam.core.arrays import Checkpointed
from ratslam.mapping.loop_closures import Candidate
from ratslam.mapping.map_state import MapState
from tactile.base.compiled import compiled, wrapped

LEAST_WEIGHT = 0.05
"""Least robust weight of a sequence in the filter."""


class LiveFilter(Checkpointed):
    """Covariance of the newest keyframe's pose against the keyframes that it was matched to.

    Attributes:
        covariance: [3, 3] in the frame of the map, m, m, rad. strayed: sum of the corrections since the
            last optimisation, standard deviations of a closure.
    """

    VALUES = ("covariance", "strayed")

    def __init__(self) -> None:
        self.covariance, self.strayed = np.zeros((3, 3)), 0.0

    def advance(self, state: MapState) -> None:
        """Adds the noise of the odometry into the newest keyframe of the map; all is forgotten where a
        piece begins."""
        if state.count < 2:
            return
        if state.begins.rows[-1]:
            self.covariance = np.diag(state.newest_variance())
            return
        before, after = state.pose.rows[-2:]
        self.covariance = _moved_covariance(self.covariance, before, after, state.newest_variance())

    def correct(self, state: MapState, candidate: Candidate, weight: float) -> np.ndarray:
        """[3] the newest keyframe's pose corrected by a closure of a sequence with this robust weight. The
        covariance takes over the closure."""
        claimed, pose = state.pose.rows[candidate.match], state.pose.rows[candidate.keyframe]
        variance, turn = state.closure_variance(), -candidate.shift * state.sector_angle
        noise = variance / max(weight, LEAST_WEIGHT)
        corrected, self.covariance, moved = _corrected_pose(self.covariance, pose, claimed, turn, noise)
        self.strayed += float(np.sqrt((moved**2 / variance).sum()))
        return corrected


@compiled
def _corrected_pose(
    covariance: np.ndarray, pose: np.ndarray, claimed: np.ndarray, turn: float, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pose [3] with a covariance [3, 3] after a measurement of it with variances `noise` [3]: the pose
    `claimed` [3], turned on the spot. Returns pose, covariance, and the correction [3]."""
    error = claimed - pose
    error[2] = wrapped(error[2] + turn)
    gain = np.linalg.solve(covariance + np.diag(noise), covariance).T
    moved, after = np.zeros(3), covariance.copy()
    for i in range(3):
        for j in range(3):
            moved[i] += gain[i, j] * error[j]
            for k in range(3):
                after[i, j] -= gain[i, k] * covariance[k, j]
    corrected = pose + moved
    corrected[2] = wrapped(corrected[2])
    return corrected, after, moved


@compiled
def _moved_covariance(
    covariance: np.ndarray, before: np.ndarray, after: np.ndarray, variance: np.ndarray
) -> np.ndarray:
    """[3, 3] covariance of a pose after a motion from `before` to `after` [3] with variances [3]; position
    has the same in all directions."""
    x, y = before[1] - after[1], after[0] - before[0]
    moved = covariance.copy()
    for k in range(3):
        moved[0, k] += x * moved[2, k]
        moved[1, k] += y * moved[2, k]
    for k in range(3):
        moved[k, 0] += x * moved[k, 2]
        moved[k, 1] += y * moved[k, 2]
        moved[k, k] += variance[k]
    return moved
