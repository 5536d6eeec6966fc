"""Pieces of a map: keyframes that odometry (not across a cut) and accepted loop closures connect."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def number_pieces(cut: np.ndarray, closures: np.ndarray) -> np.ndarray:
    """[N] the piece of each keyframe, numbered from 0 in the order of their first keyframes.

    Args:
        cut: [N] bool, the odometry is cut before the keyframe. closures: [M, 2] keyframes joined by accepted
            closures.
    """
    if not len(cut):
        return np.zeros(0, int)
    stretch = np.cumsum(cut)  # a stretch is a run of keyframes without a cut
    later, earlier = stretch[closures].T
    count = int(stretch[-1]) + 1
    joined = coo_array((np.ones(len(closures), bool), (later, earlier)), shape=(count, count))
    _, piece = connected_components(joined, directed=False)
    _, first, number = np.unique(piece[stretch], return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[number]
