"""Place ids from pairs of times that a place recogniser found alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def labels_from_pairs(
    later: Sequence[float], earlier: Sequence[float], score: Sequence[float], threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """Every time in the list is a view; its best earlier match passes on its id, else it is a new place.

    Args:
        later, earlier: s, each pair's two times, earlier before later. score: how alike they are.
        threshold: least score of a match. Of equal scores the pair listed first wins.

    Returns:
        time: [V] s, increasing. label: [V] int32, places numbered as they are first seen.
    """
    best: dict[float, tuple[float, float]] = {}
    for time, match, value in zip(later, earlier, score, strict=True):
        if value >= threshold and (time not in best or value > best[time][0]):
            best[time] = value, match
    moments = np.unique(np.concatenate([later, earlier]))
    ids: dict[float, int] = {}
    places = 0
    for moment in moments.tolist():
        if moment in best:
            ids[moment] = ids[best[moment][1]]
        else:
            ids[moment], places = places, places + 1
    return moments, np.fromiter(ids.values(), np.int32, len(ids))
