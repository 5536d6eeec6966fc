"""Pieces of a map: runs of keyframes that odometry or accepted closures join.

A keyframe may begin a piece: no odometry leads to it. Until closures join it, a piece lies in the frame of
its first keyframe, which is `APART` cells from that of the piece before, so that nothing mistakes it for a
part of the map. Once accepted closures join it, it is moved to where they claim.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tactile.base.se2 import compose, inverse

APART = 1000.0
"""Distance between the first keyframes of pieces that nothing joins, cells."""

Place = Callable[[np.ndarray], np.ndarray]
"""Moves the pieces of poses [N, 3] to where they belong, see `placed_pieces`."""
NOTHING_JOINED = np.zeros(0, int), np.zeros(0, int), np.zeros(0)
"""No closures: `i`, `j` and `turn` of `placed_pieces`."""


def piece_start(number: int, cell: float) -> np.ndarray:
    """[3] pose of the first keyframe of the piece that begins as the `number`-th, 0 for the first one."""
    return np.array([APART * cell * number, 0.0, 0.0])


def placed_pieces(
    poses: np.ndarray, begins: np.ndarray, i: np.ndarray, j: np.ndarray, turn: np.ndarray, cell: float
) -> np.ndarray:
    """[N, 3] the poses [N, 3] with pieces moved as wholes: joined ones that lie apart to where their closures
    claim, and each that is not joined to the first one to its own start. The first piece stays.

    Args:
        begins: [N] bool, a piece begins with the keyframe. i, j: [M] keyframes of accepted closures, of each
            sequence the middle one first, and of odometry links. turn: [M] see `LoopClosures`; NaN for a
            link. cell: m.
    """
    starts = np.flatnonzero(begins)
    if not len(starts):
        return poses
    # A stretch is a run of keyframes from one beginning to the next. Joined stretches are moved together;
    # `group` is the first stretch that each is joined to.
    poses, stretch = poses.copy(), np.cumsum(begins)
    group = np.arange(int(stretch[-1]) + 1)
    far = np.hypot(*(poses[i] - poses[j])[:, :2].T) > APART / 2 * cell
    for m in np.argsort(far, kind="stable").tolist():
        a, b = int(i[m]), int(j[m])
        low, high = sorted((int(group[stretch[a]]), int(group[stretch[b]])))
        if low == high:
            continue
        if far[m] and np.isfinite(turn[m]):
            frames, turned = group[stretch] == high, np.array([0.0, 0.0, turn[m]])
            if frames[b]:  # keyframe b comes to where a claims it, or a to where b does
                moved = compose(compose(poses[a], turned), inverse(poses[b]))
            else:
                moved = compose(compose(poses[b], -turned), inverse(poses[a]))
            poses[frames] = compose(moved, poses[frames])
        group[group == high] = low
    for number in np.unique(group)[1:].tolist():
        start, frames = starts[number - 1], group[stretch] == number
        moved = compose(piece_start(number, cell), inverse(poses[start]))
        poses[frames] = compose(moved, poses[frames])
    return poses


def number_pieces(broken: np.ndarray, closures: np.ndarray) -> np.ndarray:
    """[N] the piece of each keyframe, numbered from 0 in the order of their first keyframes.

    Args:
        broken: [N] bool, no odometry leads to the keyframe: it is cut before it, or a piece begins there.
            closures: [M, 2] keyframes joined by accepted closures.
    """
    if not len(broken):
        return np.zeros(0, int)
    stretch = np.cumsum(broken)
    stretch = stretch - stretch[0]  # a stretch is a run of keyframes without a break
    later, earlier = stretch[closures].T
    count = int(stretch[-1]) + 1
    joined = coo_array((np.ones(len(closures), bool), (later, earlier)), shape=(count, count))
    _, piece = connected_components(joined, directed=False)
    _, first, number = np.unique(piece[stretch], return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[number]
