"""Following a supposed pose through a session: how its views fit the ground that it would be on."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ratslam.mapping.ground import Ground
from tactile.base.se2 import compose, inverse, wrap

DEVIATIONS = 2.0
"""Standard deviations of a supposed pose by which the reach of the ground grows."""
MOST_REACH, MOST_REACH_HEADING = 3.0, 2.0
"""Largest reaches, as multiples of those of the ground."""


class Supposed(NamedTuple):
    """A supposed pose in the map: mean [3] m, m, rad; covariance [3, 3]. Or P of them: [P, 3] and
    [P, 3, 3]."""

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


def advance(
    ground: Ground, at: Supposed, moved: Motion, gain: np.ndarray | None
) -> tuple[Supposed, float | None]:
    """Moves a supposed pose, and corrects it by the keyframes near by, weighted by how well their views fit.

    Args:
        gain: [S, N] log-likelihood of the newest view at each keyframe less that at a new place, nat; None
            if it shows nothing.

    Returns:
        the pose thereafter; the gain of the best keyframe near by, nat, NaN where no keyframe is near, None
        of a view that shows nothing.
    """
    at = move(at, moved)
    if gain is None:
        return at, None
    shift, frame = ground.near(at.pose, *_reaches(ground, *at.deviations()))
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


def advance_all(ground: Ground, at: Supposed, moved: Motion, gain: np.ndarray) -> tuple[Supposed, np.ndarray]:
    """`advance` for P supposed poses that move alike, and the gains [P], nat. Most of many poses fit
    nowhere: only the others are corrected, one by one."""
    pose, covariance = (each.copy() for each in move(at, moved))
    (xx, xy, _), (_, yy, _), (*_, heading) = np.moveaxis(covariance, 0, -1)
    position = np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
    one, shift, frame = ground.near_all(pose, *_reaches(ground, position, np.sqrt(heading)))
    best = np.full(len(pose), np.nan)
    near, first = np.unique(one, return_index=True)
    if len(near):
        best[near] = np.maximum.reduceat(gain[shift, frame].astype(float), first)
    for k in np.flatnonzero(best > 0).tolist():
        corrected, _ = advance(ground, Supposed(at.pose[k], at.covariance[k]), moved, gain)
        pose[k], covariance[k] = corrected
    return Supposed(pose, covariance), best


def _reaches(ground: Ground, position: Any, heading: Any) -> tuple[Any, Any]:
    """The reaches, m and rad, of a pose with these standard deviations."""
    reach = np.minimum(ground.reach + DEVIATIONS * position, MOST_REACH * ground.reach)
    most = MOST_REACH_HEADING * ground.reach_heading
    return reach, np.minimum(ground.reach_heading + DEVIATIONS * heading, most)


def move(at: Supposed, moved: Motion) -> Supposed:
    """A pose moved by odometry, to first order in its noise (Smith and Cheeseman 1986)."""
    if not moved.motion.any() and not moved.variance.any():
        return at
    turn, lever = np.zeros((2, *at.covariance.shape))
    turn[..., 0, 0] = turn[..., 1, 1] = np.cos(at.pose[..., 2])
    turn[..., 1, 0] = np.sin(at.pose[..., 2])
    turn[..., 0, 1], turn[..., 2, 2] = -turn[..., 1, 0], 1.0
    ahead = turn @ moved.motion
    lever[..., range(3), range(3)] = 1.0
    lever[..., 0, 2], lever[..., 1, 2] = -ahead[..., 1], ahead[..., 0]
    covariance = lever @ at.covariance @ np.swapaxes(lever, -1, -2)
    covariance += (turn * moved.variance) @ np.swapaxes(turn, -1, -2)
    return Supposed(compose(at.pose, moved.motion), covariance)


def _correct(at: Supposed, error: np.ndarray, variance: np.ndarray) -> Supposed:
    """The Kalman filter's update by a measured difference [3] with this variance [3]."""
    share = np.linalg.solve((at.covariance + np.diag(variance)).T, at.covariance.T).T
    pose = at.pose + share @ error
    pose[2] = wrap(pose[2])
    covariance = at.covariance - share @ at.covariance
    return Supposed(pose, (covariance + covariance.T) / 2)
