"""Following a supposed pose through a session: how its views fit the ground that it would be on."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ratslam.alignment.ground import Ground
from tactile.base.se2 import compose, inverse, wrap

DEVIATIONS = 2.0
"""Standard deviations of a supposed pose by which the reach of the ground grows."""
MOST_REACH, MOST_REACH_HEADING = 3.0, 2.0
"""Largest reaches, as multiples of those of the ground."""


class Supposed(NamedTuple):
    """A supposed pose in the map: mean [3] m, m, rad; covariance [3, 3]."""

    pose: np.ndarray
    covariance: np.ndarray

    def is_comparable(self, ground: Ground) -> bool:
        """Whether the pose is so well known that all keyframes it may be at are compared with it."""
        position, heading = self.deviations()
        reach_heading = MOST_REACH_HEADING * ground.reach_heading
        return DEVIATIONS * position <= MOST_REACH * ground.reach and DEVIATIONS * heading <= reach_heading

    def log_share(self, ground: Ground, pose: np.ndarray) -> float:
        """Logarithm of the probability that the robot is at `pose` [3], as far as views can tell it from
        others."""
        error = pose - self.pose
        error[2] = wrap(error[2])
        spread = self.covariance + np.diag(ground.variance)
        _, volume = np.linalg.slogdet(spread)
        return float(np.log(ground.variance).sum() - volume - error @ np.linalg.solve(spread, error)) / 2

    def deviations(self) -> tuple[float, float]:
        """Standard deviations: of the position in the direction where it is largest, m; of the heading,
        rad."""
        (xx, xy), (_, yy) = self.covariance[:2, :2].tolist()
        largest = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
        return math.sqrt(largest), math.sqrt(self.covariance[2, 2])


class Motion(NamedTuple):
    """Odometry between consecutive keyframes of a session: motion [3] without its systematic errors, m, m,
    rad, and variance [3]."""

    motion: np.ndarray
    variance: np.ndarray

    def reversed(self) -> Motion:
        """The same driven backwards."""
        return Motion(inverse(self.motion), self.variance)


STILL = Motion(np.zeros(3), np.zeros(3))


def advance(ground: Ground, at: Supposed, moved: Motion, gain: np.ndarray | None) -> tuple[Supposed, float]:
    """Moves a supposed pose, and corrects it by the keyframes near by, weighted by how well their views fit.

    Args:
        gain: [S, N] log-likelihood of the newest view at each keyframe less that at a new place; None if it
            shows nothing.

    Returns:
        the pose thereafter; the gain of the best keyframe near by, NaN where no keyframe is near.
    """
    at = move(at, moved)
    if gain is None:
        return at, np.nan
    position, heading = at.deviations()
    reach = min(ground.reach + DEVIATIONS * position, MOST_REACH * ground.reach)
    most = MOST_REACH_HEADING * ground.reach_heading
    reach_heading = min(ground.reach_heading + DEVIATIONS * heading, most)
    shift, frame = ground.near(at.pose, reach, reach_heading)
    if not len(frame):
        return at, np.nan
    gains = gain[shift, frame].astype(float)
    best = float(gains.max())
    if best <= 0:
        return at, best
    weight = np.exp(gains - best)
    error = ground.claims(shift, frame) - at.pose
    error[:, 2] = wrap(error[:, 2])
    return _correct(at, (weight / weight.sum()) @ error, ground.variance), best


def move(at: Supposed, moved: Motion) -> Supposed:
    """A pose moved by odometry, to first order in its noise (Smith and Cheeseman 1986)."""
    if not moved.motion.any() and not moved.variance.any():
        return at
    cosine, sine = np.cos(at.pose[2]), np.sin(at.pose[2])
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    ahead = turn @ moved.motion
    lever = np.eye(3)
    lever[0, 2], lever[1, 2] = -ahead[1], ahead[0]
    covariance = lever @ at.covariance @ lever.T + (turn * moved.variance) @ turn.T
    return Supposed(compose(at.pose, moved.motion), covariance)


def _correct(at: Supposed, error: np.ndarray, variance: np.ndarray) -> Supposed:
    """The Kalman filter's update by a measured difference [3] with this variance [3]."""
    share = np.linalg.solve((at.covariance + np.diag(variance)).T, at.covariance.T).T
    pose = at.pose + share @ error
    pose[2] = wrap(pose[2])
    covariance = at.covariance - share @ at.covariance
    return Supposed(pose, (covariance + covariance.T) / 2)
