"""Whether views alone separate places: differences of views of the same place and of different places."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from evaluation.metrics.statistics import auc
from tactile.base.errors import InputError
from tactile.base.se2 import wrap

SAME_DISTANCE, SAME_HEADING, VISIT_GAP = 0.05, np.radians(15), 60.0
"""Two views are of the same place if taken within this distance (m) and heading (rad) on two visits, at least
this far apart in time (s)."""
OTHER_DISTANCE = 0.3
"""Two views are of different places if taken farther apart, m."""
BINS = 60
ROWS = 64
"""Views compared with all others at a time."""


class ViewDifferences(NamedTuple):
    """Differences of pairs of views.

    Attributes:
        edge: [BINS + 1] of the histograms. same, other: [BINS] pairs of views of one place, of two places.
        auc: probability that a pair of different places differs more than a pair of the same; 0.5: the views
            do not separate places.
    """

    edge: np.ndarray
    same: np.ndarray
    other: np.ndarray
    auc: float

    def quantile(self, count: np.ndarray, share: float) -> float:
        """The difference below which this share of the pairs of a histogram [BINS] lies."""
        return float(np.interp(share * count.sum(), _below_edges(count), self.edge))

    def share_below(self, count: np.ndarray, difference: float) -> float:
        """The share of the pairs of a histogram [BINS] below a difference."""
        return np.interp(difference, self.edge, _below_edges(count)) / count.sum()


def compare_views(
    views: np.ndarray,
    truth: np.ndarray,
    time: np.ndarray,
    differences: Callable[[np.ndarray, np.ndarray], np.ndarray],
    name: str,
) -> ViewDifferences:
    """The differences of the views of a session, of the same place and of different ones.

    Args:
        views: [T, ...]. truth: [T, 3] true poses. time: [T] s. differences: of N views from M others, [N, M].
            name: of the session, for errors.

    Raises:
        InputError: no place was visited twice.
    """
    same, other = [np.zeros(0)], [np.zeros(0)]
    for start in range(0, len(views), ROWS):
        rows = slice(start, start + ROWS)
        later = np.arange(len(views)) > np.arange(len(views))[rows, None]
        apart = np.hypot(*(truth[None, :, :2] - truth[rows, None, :2]).transpose(2, 0, 1))
        turned = np.abs(wrap(truth[None, :, 2] - truth[rows, None, 2]))
        again = np.abs(time - time[rows, None]) >= VISIT_GAP
        difference = differences(views[rows], views)
        same.append(difference[later & again & (apart < SAME_DISTANCE) & (turned < SAME_HEADING)])
        other.append(difference[later & (apart > OTHER_DISTANCE)])
    a, b = np.concatenate(same), np.concatenate(other)
    if not len(a) or not len(b):
        found = "no place with views of two visits" if len(b) else "a path that stays at one place"
        raise InputError(name, found, "a path that returns to earlier places")
    edge = np.linspace(0.0, max(a.max(), b.max(), 1e-9), BINS + 1)
    return ViewDifferences(edge, np.histogram(a, edge)[0], np.histogram(b, edge)[0], auc(a, b))


def image_difference(views: np.ndarray, reference: np.ndarray, tallest: float) -> tuple[float, float]:
    """Difference of images [N, R, C, K] in their first channel.

    Args:
        tallest: height of a white pixel, m.

    Returns:
        share of pixels whose contact state differs; mean absolute height difference where both have contact,
        m, NaN where none do.
    """
    a, b = views[..., 0], reference[..., 0]
    both = (a > 0) & (b > 0)
    height = float(np.abs(a - b)[both].mean() * tallest) if both.any() else np.nan
    return float(((a > 0) != (b > 0)).mean()), height


def _below_edges(count: np.ndarray) -> np.ndarray:
    """[BINS + 1] number of pairs below each edge."""
    return np.concatenate([[0], np.cumsum(count)])
