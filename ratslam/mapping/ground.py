"""The keyframes of a finished map as ground on which a session is placed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.recall.config import RecallConfig, sector_shifts
from tactile.base.se2 import wrap

REACH = 1.2
"""Distance from a keyframe within which the robot is at it, cells."""
REACH_HEADING = 0.3
"""Difference in heading within which a view is compared with a keyframe's, rad; at least 0.6 of the turn
between two sector shifts."""


NEAR = 0.5
"""Largest distance and turn from a keyframe at which a view counts by its gain, as shares of the ground's
reaches: beside the driven way, and at headings that were not driven, views differ although the pose is
right."""


class Match(NamedTuple):
    """The row of a sector shift, a keyframe of a ground, and the gain of a view there, nat."""

    shift: int
    frame: int
    gain: float


class Ground(NamedTuple):
    """N keyframes, each with S headings at which a robot there may be compared with it.

    Attributes:
        poses: [N, 3] m, m, rad. turns: [S] heading of the robot less that of the keyframe at each sector
            shift, rad. reach, reach_heading: m and rad. variance: [3] of a pose found by comparing views, m²,
            m², rad². near_share: share of the reaches within which a view counts by its gain.
    """

    poses: np.ndarray
    turns: np.ndarray
    reach: float
    reach_heading: float
    variance: np.ndarray
    near_share: float = NEAR

    def near(self, pose: np.ndarray, reach: float, reach_heading: float) -> tuple[np.ndarray, np.ndarray]:
        """The sector shifts [n] and keyframes [n] at which a robot at `pose` [3] is compared.

        Args:
            reach, reach_heading: m, rad.
        """
        apart = (self.poses[:, 0] - pose[0]) ** 2 + (self.poses[:, 1] - pose[1]) ** 2
        close = np.flatnonzero(apart < reach**2)
        turned = np.abs(wrap(self.poses[close, 2] + self.turns[:, None] - pose[2]))
        shift, row = np.nonzero(turned < reach_heading)
        return shift, close[row]

    def near_all(
        self, poses: np.ndarray, reach: np.ndarray, reach_heading: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`near` for poses [P, 3], each with its reaches [P].

        Returns:
            the numbers [n] of the poses, in order; the sector shifts [n] and keyframes [n].
        """
        x, y, heading = self.poses.T
        apart = (x - poses[:, :1]) ** 2 + (y - poses[:, 1:2]) ** 2
        one, frame = np.nonzero(apart < reach[:, None] ** 2)
        turned = np.abs(wrap(heading[frame, None] + self.turns - poses[one, 2:]))
        row, shift = np.nonzero(turned < reach_heading[one, None])
        return one[row], shift, frame[row]

    def best_match(self, pose: np.ndarray, gain: np.ndarray) -> Match | None:
        """Where a view with gains [S, N or more] fits best of what a robot at `pose` [3] is compared with;
        None where it fits nothing better than a new place."""
        shift, frame = self.near(pose, self.reach, self.reach_heading)
        gains = gain[shift, frame]
        if not (gains > 0).any():
            return None
        best = int(np.argmax(gains))
        return Match(int(shift[best]), int(frame[best]), float(gains[best]))

    def is_near(self, pose: np.ndarray) -> bool:
        """Whether a robot at `pose` [3] is so near a keyframe that its view counts by its gain."""
        share = self.near_share
        return len(self.near(pose, share * self.reach, share * self.reach_heading)[0]) > 0

    def is_passed(self, pose: np.ndarray) -> bool:
        """Whether a keyframe is within reach of `pose` [3], whatever its heading."""
        return bool(np.hypot(*(self.poses[:, :2] - pose[:2]).T).min() < self.reach)

    def claims(self, shift: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """[n, 3] poses of a robot whose view is that of keyframes [n] at sector shifts [n]."""
        claimed = self.poses[frame].copy()
        claimed[:, 2] = wrap(claimed[:, 2] + self.turns[shift])
        return claimed

    def places(self) -> float:
        """Number of poses that can be told apart: keyframes within reach of each other count as one."""
        density = [len(self.near(pose, self.reach, self.reach_heading)[0]) for pose in self.poses]
        return float((len(self.turns) / np.maximum(density, 1)).sum())


def ground_of(
    poses: np.ndarray,
    recall: RecallConfig,
    cell: float,
    sector_angle: float,
    variance: np.ndarray,
    near_share: float = NEAR,
) -> Ground:
    """Keyframes at these poses [N, 3] as ground.

    Args:
        cell: size of a pose cell, m. sector_angle: turn per sector shift, rad.
        variance, near_share: see `Ground`.
    """
    turns = -sector_shifts(recall) * sector_angle
    least = 0.6 * abs(sector_angle) if len(turns) > 2 else 0.0
    return Ground(poses, turns, REACH * cell, max(REACH_HEADING, least), variance, near_share)
