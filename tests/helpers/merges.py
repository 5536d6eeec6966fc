"""Merges of keyframes drawn at random."""

import numpy as np

from ratslam.recall.memory import MergedRows


def random_merge(stream: np.random.Generator, count: int) -> MergedRows:
    """About half of `count` keyframes merged with older ones, of which half face the other way."""
    gone = stream.random(count) < 0.5
    gone[0] = False
    kept = np.flatnonzero(~gone)
    onto = np.array([k if not gone[k] else stream.choice(kept[kept < k]) for k in range(count)])
    offset = np.where(gone[:, None], stream.normal(0, 0.1, (count, 3)), 0.0)
    offset[:, 2] += np.pi * (gone & (stream.random(count) < 0.5))
    return MergedRows(kept, (np.cumsum(~gone) - 1)[onto], offset)
