"""Closure sequences along the poses of a map, where its views fit.

Recall proposes few sequences on a stretch between two cuts of the odometry, so the stretch is bent and its
views look as if it were elsewhere. Where the poses of two keyframes are near each other and the view fits,
they are a closure. The rule is ours."""

from __future__ import annotations

import numpy as np

from ratslam.core.compiled import compiled
from ratslam.keyframes.loop_closures import Candidate, ClosureLog
from ratslam.keyframes.pose_tracks import TrackGround

LONGEST = 10
"""Largest number of closures of one sequence, which is accepted or refused as a whole."""


def add_closures_along(log: ClosureLog, ground: TrackGround, cuts: np.ndarray, max_gap: int) -> None:
    """Adds to the log the earlier keyframe that fits best at the pose of each keyframe, where any fits better
    than a new place.

    Args:
        cuts: keyframes [n], ascending, before which the odometry is cut; no sequence lies across one.
            max_gap: largest number of keyframes between two closures of a sequence.
    """
    reach = ground.reach, ground.reach_heading
    match, shift, fit = _best_earlier(ground.poses, ground.turns, ground.fits, *reach)
    part = np.searchsorted(cuts, np.arange(ground.size), side="right")
    before, length = -1, 0
    for frame in np.flatnonzero(fit > 0).tolist():
        near = before >= 0 and frame - before <= max_gap and part[frame] == part[before]
        follows = bool(near and length < LONGEST)
        gain = float(fit[frame])
        posterior = float(1 / (1 + np.exp(-gain)))
        log.add(Candidate(frame, int(match[frame]), int(shift[frame]), posterior, gain), follows)
        before, length = frame, length + 1 if follows else 1


@compiled
def _best_earlier(
    poses: np.ndarray, turns: np.ndarray, fits: np.ndarray, reach: float, turn: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For each keyframe the earlier one near it that fits best, its row of `turns`, and the fit [N], -inf
    without any."""
    count = len(poses)
    match, shift, best = np.zeros(count, np.int64), np.zeros(count, np.int64), np.full(count, -np.inf)
    for k in range(count):
        for i in range(k):
            x, y = poses[i, 0] - poses[k, 0], poses[i, 1] - poses[k, 1]
            if x * x + y * y >= reach * reach:
                continue
            for s in range(len(turns)):
                angle = (poses[i, 2] + turns[s] - poses[k, 2] + np.pi) % (2 * np.pi) - np.pi
                if abs(angle) < turn and fits[k, s, i] > best[k]:
                    match[k], shift[k], best[k] = i, s, fits[k, s, i]
    return match, shift, best
