"""Laps of a robot that is carried ahead once, and how well each view fits at every other keyframe."""

from __future__ import annotations

import numpy as np

from ratslam.mapping.ground import REACH, REACH_HEADING, GainOdds, Ground
from ratslam.mapping.pose_tracks import SelfTraverse
from tactile.base.se2 import between, integrate
from tests.ratslam.mapping.selection_cases import LAP, NOISE, SPREAD, STEP, lap_poses

COUNT = 3 * LAP
FIT = 3.0
"""Log-odds of a view at its place, and against it elsewhere."""
ODDS = GainOdds(np.array([0.0]), np.array([-2.0, 2.0]), 2.0)


def places(jump: int | None, ahead: int) -> np.ndarray:
    """[COUNT] the place of each keyframe along the lap; carried ahead before keyframe `jump`."""
    place = np.arange(COUNT)
    if jump is not None:
        place[jump:] += ahead
    return place % LAP


def laps(place: np.ndarray, shown: np.ndarray | None = None) -> SelfTraverse:
    """A map by odometry alone, which does not measure that the robot is carried.

    Args:
        shown: [COUNT] the places whose views are seen; None: those of the robot.
    """
    shown = place if shown is None else shown
    steps = between(lap_poses(np.arange(COUNT - 1)), lap_poses(np.arange(1, COUNT)))
    motions = steps[place[:-1]]
    poses = np.vstack([lap_poses(place[:1]), integrate(motions, lap_poses(place[:1])[0])])
    apart = np.abs((shown[:, None] - place + LAP // 2) % LAP - LAP // 2)
    fits = np.where(apart <= 1, FIT, -FIT).astype(np.float32)
    time = np.arange(COUNT)
    fits[np.abs(time[:, None] - time) <= LAP // 2] = -np.inf
    variances = np.tile((0.2 * NOISE) ** 2, (COUNT - 1, 1))
    reach = REACH * STEP / 0.6
    ground = Ground(poses, np.zeros(1), reach, REACH_HEADING, SPREAD**2)
    return SelfTraverse(ground, fits[:, None], motions, variances)
