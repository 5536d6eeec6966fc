"""A piece of a finished map over the ground of another one.

The piece is solved: as a whole it lies on the ground nearly as a rigid body. So where the robot comes back
from a way that the other map does not have, its pose follows from all places confirmed so far, and not from a
long way of odometry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.alignment.comparison import Comparison
from ratslam.alignment.following import STILL, Motion, Supposed, advance
from ratslam.alignment.gain_odds import GainOdds
from ratslam.alignment.ground import Ground
from ratslam.alignment.paths import Path, keyframe_odds
from ratslam.atlas.placement import Stretch, Traverse
from tactile.base.se2 import between, compose, fit_rigid_motion, inverse, wrap

UNCONFIRMED = 6
"""Keyframes without evidence for a pose, after which it is that of the piece as a rigid body."""
TOGETHER = 20
"""Least number of keyframes with evidence for their poses that one rigid motion brings there."""


class MapTraverse(NamedTuple):
    """A solved piece of n keyframes over a ground.

    Attributes:
        views: compared with the ground. poses: [n, 3] in the piece, m, m, rad. motions: [n] into each
            keyframe, the first one's not used. hopeless: log-odds of the way to either end below which a
            placement is dropped.
    """

    views: Comparison
    poses: np.ndarray
    motions: list[Motion]
    hopeless: float

    def follow(self, ground: Ground, odds: GainOdds, k: int, pose: np.ndarray) -> Stretch:
        """The path with keyframe k at `pose` [3]: of the whole piece as a rigid body if many places agree on
        one; else as odometry leads, as far as it is not hopeless."""
        way = Traverse(self.views, self.motions, self.hopeless).follow(ground, odds, k, pose)
        confirmed = np.flatnonzero(way.path.odds > 0)
        own, found = self.poses[way.first + confirmed], way.path.poses[confirmed]
        together = _largest_rigid_part(ground, own, found)
        if together.sum() < TOGETHER:
            return way
        moved = fit_rigid_motion(own[together], found[together])
        return Stretch(0, self._along(ground, odds, moved))

    def _along(self, ground: Ground, odds: GainOdds, moved: np.ndarray) -> Path:
        """The path of the piece moved by `moved` [3], corrected by the views."""
        rigid, loose = compose(moved, self.poses), np.diag(ground.variance)
        at, inside, unconfirmed = Supposed(rigid[0], loose), False, UNCONFIRMED
        poses, covariances, gained = np.empty_like(rigid), np.empty((len(rigid), 3, 3)), np.zeros(len(rigid))
        for k, motion in enumerate(self.motions):
            if unconfirmed >= UNCONFIRMED:
                at, motion = Supposed(rigid[k], loose), STILL
            at, gain = advance(ground, at, motion, self.views.gains(k))
            gained[k], inside = keyframe_odds(ground, odds, at.pose, gain, inside)
            poses[k], covariances[k] = at
            unconfirmed = 0 if gained[k] > 0 else unconfirmed + 1
        return Path(poses, covariances, gained)


def _largest_rigid_part(ground: Ground, own: np.ndarray, found: np.ndarray) -> np.ndarray:
    """[n] bool: the most poses `own` [n, 3] that one rigid motion brings to within the ground's reaches of
    those `found` [n, 3]."""
    best = np.zeros(len(own), bool)
    for k in range(len(own)):
        apart = between(compose(compose(found[k], inverse(own[k])), own), found)
        near = np.hypot(*apart[:, :2].T) < ground.reach
        together = near & (np.abs(wrap(apart[:, 2])) < ground.reach_heading)
        if together.sum() > best.sum():
            best = together
    return best
