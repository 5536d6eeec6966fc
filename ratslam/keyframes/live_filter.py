"""The newest keyframe's pose between two optimisations of the map.

An optimisation costs time that grows with the map, so it does not follow every closure. In between, a
Kalman filter moves the newest keyframe by the odometry, and corrects it by every closure of an accepted
sequence; the matched keyframes count as known. The next optimisation replaces the pose. Source: Thrun,
Burgard & Fox 2005, table 7.2 (extended Kalman filter with known correspondences)."""

from __future__ import annotations

import numpy as np

from ratslam.core.checkpoint import Checkpointed
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.loop_closures import Candidate
from tactile.base.se2 import compose, wrap

LEAST_WEIGHT = 0.05
"""Least robust weight of a sequence in the filter."""


class LiveFilter(Checkpointed):
    """Covariance of the newest keyframe's pose against the keyframes that it was matched to.

    Attributes:
        covariance: [3, 3] in the frame of the map, m, m, rad. strayed: sum of the corrections since the last
            optimisation, standard deviations of a closure.
    """

    VALUES = ("covariance", "strayed")

    def __init__(self) -> None:
        self.covariance, self.strayed = np.zeros((3, 3)), 0.0

    def advance(self, graph: KeyframeGraph) -> None:
        """Adds the noise of the odometry into the newest keyframe of `graph`; all is forgotten where a piece
        begins."""
        if graph.count < 2:
            return
        if graph.begins.rows[-1]:
            self.covariance = np.diag(graph.newest_variance())
            return
        before, after = graph.pose.rows[-2:]
        dx, dy = (after - before)[:2]
        by_pose = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1.0]])
        noise = np.diag(graph.newest_variance())  # position has the same in all directions
        self.covariance = by_pose @ self.covariance @ by_pose.T + noise

    def correct(self, graph: KeyframeGraph, candidate: Candidate, weight: float) -> np.ndarray:
        """[3] the newest keyframe's pose corrected by a closure of a sequence with this robust weight. The
        covariance takes over the closure."""
        turn = np.array([0.0, 0.0, -candidate.shift * graph.sector_angle])
        claimed = compose(graph.pose.rows[candidate.match], turn)
        error = claimed - graph.pose.rows[candidate.keyframe]
        error[2] = wrap(error[2])
        noise = np.diag(graph.closure_variance()) / max(weight, LEAST_WEIGHT)
        gain = np.linalg.solve(self.covariance + noise, self.covariance).T
        self.covariance = self.covariance - gain @ self.covariance
        moved: np.ndarray = gain @ error
        self.strayed += float(np.sqrt((moved**2 / graph.closure_variance()).sum()))
        corrected: np.ndarray = graph.pose.rows[candidate.keyframe] + moved
        corrected[2] = wrap(corrected[2])
        return corrected

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces the whole state by that of `arrays`; in earlier map files nothing has strayed."""
        super().restore({"strayed/0": np.array(0.0)} | arrays)
