"""Places of the pieces of a map that nothing joins: their poses are arbitrary, so they lie far apart.

A keyframe may begin a piece: no odometry leads to it. Until closures join it, a piece lies in the frame of
its first keyframe, which is `APART` cells from that of the piece before: nothing mistakes it for a part of
the map. Once accepted closures join it, it is moved to where they claim."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tactile.base.se2 import compose, inverse

APART = 1000.0
"""Distance between the first keyframes of pieces that nothing joins, cells."""


NOTHING_JOINED = np.zeros(0, int), np.zeros(0, int), np.zeros(0)
"""No closures: `i`, `j` and `turn` of a `PiecePlacement`."""


def piece_start(number: int, cell: float) -> np.ndarray:
    """[3] pose of the first keyframe of the piece that begins as the `number`-th, 0 for the first one."""
    return np.array([APART * cell * number, 0.0, 0.0])


class PiecePlacement(NamedTuple):
    """What joins the pieces of N keyframes.

    Attributes:
        begins: [N] bool, a piece begins with the keyframe. i, j: [M] keyframes of accepted closures, of each
            sequence the middle one first, and of odometry links. turn: [M] see `LoopClosures`; NaN for a
            link. cell: m.
    """

    begins: np.ndarray
    i: np.ndarray
    j: np.ndarray
    turn: np.ndarray
    cell: float

    def place(self, poses: np.ndarray) -> np.ndarray:
        """[N, 3] the poses with pieces moved as wholes: joined ones that lie apart to where their closures
        claim, and each that is not joined to the first one to its own start. The first piece stays."""
        starts = np.flatnonzero(self.begins)
        if not len(starts):
            return poses
        poses, stretch = poses.copy(), np.cumsum(self.begins)
        group = self._gather(poses, stretch)
        for number in np.unique(group)[1:].tolist():
            start, frames = starts[number - 1], group[stretch] == number
            moved = compose(piece_start(number, self.cell), inverse(poses[start]))
            poses[frames] = compose(moved, poses[frames])
        return poses

    def _gather(self, poses: np.ndarray, stretch: np.ndarray) -> np.ndarray:
        """Moves joined stretches together, in place; returns the first stretch that each is joined to."""
        group = np.arange(int(stretch[-1]) + 1)
        far = np.hypot(*(poses[self.i] - poses[self.j])[:, :2].T) > APART / 2 * self.cell
        for m in np.argsort(far, kind="stable").tolist():
            i, j = int(self.i[m]), int(self.j[m])
            low, high = sorted((int(group[stretch[i]]), int(group[stretch[j]])))
            if low == high:
                continue
            if far[m] and np.isfinite(self.turn[m]):
                frames = group[stretch] == high
                poses[frames] = compose(self._motion(poses, m, bool(frames[j])), poses[frames])
            group[group == high] = low
        return group

    def _motion(self, poses: np.ndarray, m: int, of_later: bool) -> np.ndarray:
        """[3] the motion that brings the keyframe j of a closure to where i claims it, or i to j."""
        i, j = int(self.i[m]), int(self.j[m])
        turn = np.array([0.0, 0.0, self.turn[m]])
        if of_later:
            return compose(compose(poses[i], turn), inverse(poses[j]))
        return compose(compose(poses[j], -turn), inverse(poses[i]))
