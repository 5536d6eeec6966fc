"""Log-odds of gains that were learned for grounds, kept so that a restored session uses the same ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ratslam.alignment.gain_odds import BINS, GainOdds
from ratslam.core.checkpoint import Checkpointed
from ratslam.core.growable_array import GrowableArray

GroundKey = tuple[int, int, int]
"""What tells a ground from the others of a map: its number of keyframes, its first and its last keyframe."""


class LearnedOdds(Checkpointed):
    """The log-odds of gains on each ground, as they were when it was first asked for.

    Learning them takes long, so they are not learned anew while the ground is the same, although the poses
    and the metric of the views change a little. A checkpoint without any has no array of them.
    """

    def __init__(self) -> None:
        self.ground = GrowableArray((3,), np.int64)
        self.edges = GrowableArray((BINS - 1,), np.float64)
        self.odds = GrowableArray((BINS,), np.float64)
        self.expected = GrowableArray((), np.float64)

    def of(self, ground: GroundKey, learn: Callable[[], GainOdds]) -> GainOdds:
        """The log-odds on a ground; `learn` is called if they are not known."""
        known = np.flatnonzero((self.ground.rows == ground).all(axis=1))
        if len(known):
            row = int(known[0])
            return GainOdds(self.edges.rows[row], self.odds.rows[row], float(self.expected.rows[row]))
        found = learn()
        self.ground.append(ground)
        for array, values in zip((self.edges, self.odds, self.expected), found, strict=True):
            array.append(values)
        return found

    def arrays(self) -> dict[str, np.ndarray]:
        return super().arrays() if len(self.ground.rows) else {}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        if arrays:
            super().restore(arrays)
        else:
            for array in (self.ground, self.edges, self.odds, self.expected):
                array.replace(array.rows[:0])
