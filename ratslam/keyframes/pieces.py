"""Pieces of a map: keyframes that odometry (not across a break) and accepted loop closures connect."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


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
