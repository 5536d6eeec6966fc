"""Log-odds that a session is where it is supposed to be, learned from the map's own revisits.

A view's *gain* at a supposed pose is its log-likelihood there less that at a new place. Gains of true poses
are high; of false poses that happen to look alike they are lower and scattered. Both distributions are
counted in the map itself: at revisits, and at the other places that look most alike for a while. So the odds
need no constant of the sensor. The method is ours."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from ratslam.core.checkpoint import Checkpointed
from ratslam.core.growable_array import GrowableArray

BINS = 24
"""Number of bins of the gain."""
PRIOR_COUNT = 40.0
"""Number of gains that the prior counts as."""
FARTHEST = 20.0
"""Largest absolute value of the limits between bins, nat: gains beyond are certain, and finer bins tell
more."""
OUTLIERS = 0.04
"""Share of either distribution that is drawn from the other: something has changed, or was misread."""
LEAVING = -2.0
"""Log-odds of leaving mapped ground: false supposed poses do so more often than true ones."""


class GainPrior(NamedTuple):
    """Gains before any were counted: mean and standard deviation at `true` and at `false` poses, nat."""

    true: tuple[float, float]
    false: tuple[float, float]


class GainOdds(NamedTuple):
    """Attributes:
    edges: [BINS - 1] limits between the bins of the gain, nat. odds: [BINS] log-odds of each, ascending,
        nat. expected: mean log-odds at a true pose, nat.
    """

    edges: np.ndarray
    odds: np.ndarray
    expected: float

    def of(self, gain: float) -> float:
        """Log-odds of one gain, both in nat."""
        return float(self.odds[np.searchsorted(self.edges, gain)])


PRIOR = GainPrior(true=(1.9, 0.8), false=(0.5, 1.6))
"""Of plain gains."""


def learn_gain_odds(true: np.ndarray, false: np.ndarray, prior: GainPrior = PRIOR) -> GainOdds:
    """Log-odds of gains from those counted at true poses [n] and at false ones [m]."""
    from scipy.optimize import isotonic_regression  # slow to import

    prior_true, prior_false = (_quantiles(*each) for each in prior)
    pooled = np.concatenate([true, false, prior_true, prior_false])
    low, high = np.clip(np.quantile(pooled, [0.005, 0.995]), -FARTHEST, FARTHEST).tolist()
    edges = np.linspace(low, high, BINS - 1)
    same, other = _density(edges, true, prior_true), _density(edges, false, prior_false)
    mixed_same, mixed_other = (
        (1 - OUTLIERS) * same + OUTLIERS * other,
        (1 - OUTLIERS) * other + OUTLIERS * same,
    )
    tiny = np.finfo(float).tiny  # a bin without counts has no odds
    raw = np.log((mixed_same + tiny) / (mixed_other + tiny))
    # A better fit is never evidence against a place; bins without gains say little.
    odds = isotonic_regression(raw, weights=same + other + 1e-6).x
    return GainOdds(edges, odds, float(same @ odds))


def _quantiles(mean: float, deviation: float) -> np.ndarray:
    """Evenly spread quantiles of a normal distribution."""
    from scipy.special import ndtri  # slow to import

    share = (np.arange(64) + 0.5) / 64
    return mean + deviation * ndtri(share)


def _density(edges: np.ndarray, counted: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """[BINS] smoothed shares of the counted gains and of the prior."""
    count = np.bincount(np.searchsorted(edges, counted), minlength=BINS).astype(float)
    count += PRIOR_COUNT / len(prior) * np.bincount(np.searchsorted(edges, prior), minlength=BINS)
    smooth = np.convolve(np.pad(count, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    return smooth / smooth.sum()


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


COMMON = 0.5
"""Factor on the logarithm of a view's mean likelihood over the whole ground, subtracted from its gains."""
COMMON_OF_PIECE = 0.25
"""The same factor for a piece of a growing map."""


class Weighing(NamedTuple):
    """Attributes:
    weigh: from gains [..., S, N] of views on a whole ground to those that are counted. prior: of these.
    matching: mean of those before one above which a false pose still looks right, nat.
    """

    weigh: Callable[[np.ndarray], np.ndarray]
    prior: GainPrior
    matching: float


def _as_they_are(gain: np.ndarray) -> np.ndarray:
    return gain


def less_where_common(gain: np.ndarray, share: float = COMMON) -> np.ndarray:
    """Gains [..., S, N] of views on a ground, less where the whole ground fits a view: a view that fits many
    places, or any wall, tells little of where the robot is, nor whether it is on this ground. Ours; a full
    Bayes filter would divide by the mean likelihood."""
    most = gain.max(axis=(-2, -1), keepdims=True, initial=-np.inf)
    mean = np.exp(gain - most).mean(axis=(-2, -1), keepdims=True)
    return gain - share * (most + np.log(mean))


PLAIN = Weighing(_as_they_are, PRIOR, 1.0)
"""For two pieces of finished maps, of which many keyframes are compared."""
PIECE = Weighing(
    partial(less_where_common, share=COMMON_OF_PIECE), GainPrior(true=(2.4, 0.8), false=(1.0, 1.6)), 1.5
)
"""For the newest piece of a growing map."""
DISTINCT = Weighing(less_where_common, GainPrior(true=(2.95, 0.8), false=(1.55, 1.6)), 2.0)
"""For a session of which few keyframes are known."""
