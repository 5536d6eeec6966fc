"""Whether two sessions of one map are joined, and rightly."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from evaluation.metrics.trajectory import align
from evaluation.papers.maps.localisation_metrics import (
    RIGHT,
    SAME_HEADING,
    WRONG,
    Tolerance,
    exceeds,
    is_revisited,
    known_steps,
    localisation_errors,
)
from evaluation.papers.maps.stored_maps import MapArrays
from tactile.base.se2 import compose

REVISIT = Tolerance(RIGHT.distance, float(SAME_HEADING))
"""A later step is a revisit of an earlier one that is as near as this."""


class Join(NamedTuple):
    """How the later session lies in the map of the earlier one.

    Attributes:
        joined: whether most steps of both are in one piece. error: [2] median error of the later session's
            poses against the earlier steps (m, rad), NaN without a step to compare. path: [T, 2] positions of
            the later session (m) after the alignment of the earlier one to the truth.
    """

    joined: bool
    error: np.ndarray
    path: np.ndarray

    @property
    def right(self) -> bool:
        """Joined, and not off by more than `WRONG`."""
        return self.joined and not exceeds(self.error[None], WRONG)[0]

    @property
    def wrong(self) -> bool:
        """Joined, and off by more than `WRONG`."""
        return self.joined and bool(exceeds(self.error[None], WRONG)[0])


def shown_paths(first: np.ndarray, second: np.ndarray, join: Join) -> dict[str, np.ndarray]:
    """Paths [.., 2] (m) of two sessions by label: the true ones, and that of the second one in the map of the
    first if they are joined."""
    paths = {"first session": first, "second, true": second}
    return paths | {"second, in the map": join.path} if join.joined else paths


def judge_join(arrays: MapArrays, earlier: int, entry: int = 0, revisits: bool = False) -> Join:
    """Compares the steps after the first `earlier` ones with these.

    Args:
        entry: number of later steps that are left out first. revisits: whether to compare revisits alone
            (`REVISIT`).
    """
    first, last = slice(earlier), slice(earlier + entry, None)
    piece = _most_common(arrays.piece[first])
    joined = piece == _most_common(arrays.piece[last])
    inside = arrays.piece[first] == piece
    steps = known_steps(arrays.trajectory[first][inside], arrays.truth[first][inside])
    pose, truth = arrays.trajectory[last], arrays.truth[last]
    if revisits:
        again = is_revisited(steps, truth, REVISIT)
        pose, truth = pose[again], truth[again]
    error = localisation_errors(steps, pose, truth, RIGHT.distance)
    known = np.isfinite(error).all(axis=1)
    middle = np.median(error[known], axis=0) if known.any() else np.full(2, np.nan)
    shown = compose(align(steps.pose, steps.truth), arrays.trajectory[earlier:])
    return Join(joined, middle, shown[:, :2])


def _most_common(pieces: np.ndarray) -> int:
    values, counts = np.unique(pieces, return_counts=True)
    return int(values[np.argmax(counts)])
