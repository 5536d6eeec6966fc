"""Closure sequences along the poses of a map, where its views fit.

Recall proposes few sequences on a stretch between two cuts of the odometry, so the stretch is bent and its
views look as if it were elsewhere. Where the poses of two keyframes are near each other and the view fits,
they are a closure. The rule is ours."""

from __future__ import annotations

import numpy as np

from ratslam.keyframes.loop_closures import Candidate, ClosureLog
from ratslam.keyframes.pose_tracks import SelfTraverse

LONGEST = 10
"""Largest number of closures of one sequence, which is accepted or refused as a whole."""


def add_closures_along(log: ClosureLog, session: SelfTraverse, cuts: np.ndarray, max_gap: int) -> None:
    """Adds to the log the earlier keyframe that fits best at the pose of each keyframe, where any fits better
    than a new place.

    Args:
        cuts: keyframes [n], ascending, before which the odometry is cut; no sequence lies across one.
            max_gap: largest number of keyframes between two closures of a sequence.
    """
    part = np.searchsorted(cuts, np.arange(session.size), side="right")
    before, length = -1, 0
    for frame, pose in enumerate(session.poses):
        earlier = session.ground._replace(poses=session.poses[:frame])
        best = earlier.best_match(pose, session.fits[frame])
        if best is None:
            continue
        near = before >= 0 and frame - before <= max_gap and part[frame] == part[before]
        follows = bool(near and length < LONGEST)
        posterior = float(1 / (1 + np.exp(-best.gain)))
        log.add(Candidate(frame, best.frame, best.shift, posterior, best.gain), follows)
        before, length = frame, length + 1 if follows else 1
