"""The keyframes of a map as ground, pose hypotheses that move over it, and the log-odds that they are right.

A pose hypothesis is moved by odometry and corrected by the keyframes near by, weighted by the likelihoods
of the view there (an extended Kalman filter; Smith & Cheeseman 1986). A view's *gain* at a pose is its
log-likelihood there less that at a new place. Gains of true poses are high; of false poses that happen to
look alike they are lower and scattered. Both distributions are counted in the map itself, at revisits and
at the other places that look most alike for a while, so the odds need no constant of the sensor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.core.compiled import compiled
from tactile.base.se2 import compose, inverse, wrap

REACH = 1.2
"""Distance from a keyframe within which the robot is at it, cells."""
REACH_HEADING = 0.3
"""Difference in heading within which a view is compared with a keyframe's, rad; at least 0.6 of the turn
between two sector shifts."""


NEAR = 0.5
"""Largest distance and turn from a keyframe at which a view counts by its gain, as shares of the ground's
reaches: beside the driven way, and at headings that were not driven, views differ although the pose is
right."""


class Match(NamedTuple):
    """The row of a sector shift, a keyframe of a ground, and the gain of a view there, nat."""

    shift: int
    frame: int
    gain: float


class Ground(NamedTuple):
    """N keyframes, each with S headings at which a robot there may be compared with it.

    Attributes:
        poses: [N, 3] m, m, rad. turns: [S] heading of the robot less that of the keyframe at each sector
            shift, rad. reach, reach_heading: m and rad. variance: [3] of a pose found by comparing views,
            m², m², rad². near_share: share of the reaches within which a view counts by its gain.
    """

    poses: np.ndarray
    turns: np.ndarray
    reach: float
    reach_heading: float
    variance: np.ndarray
    near_share: float = NEAR

    @classmethod
    def of(
        cls, poses: np.ndarray, shift: np.ndarray, cell: float, turn: float, variance: np.ndarray, near: float
    ) -> Ground:
        """Keyframes at these poses [N, 3] as ground.

        Args:
            shift: [S] sector shifts. cell: size of a pose cell, m. turn: per sector shift, rad. near:
                `near_share`.
        """
        turns, least = -shift * turn, 0.6 * abs(turn) if len(shift) > 2 else 0.0
        return cls(poses, turns, REACH * cell, max(REACH_HEADING, least), variance, near)

    def near(self, pose: np.ndarray, reach: float, reach_heading: float) -> tuple[np.ndarray, np.ndarray]:
        """The sector shifts [n] and keyframes [n] at which a robot at `pose` [3] is compared.

        Args:
            reach, reach_heading: m, rad.
        """
        apart = (self.poses[:, 0] - pose[0]) ** 2 + (self.poses[:, 1] - pose[1]) ** 2
        close = np.flatnonzero(apart < reach**2)
        turned = np.abs(wrap(self.poses[close, 2] + self.turns[:, None] - pose[2]))
        shift, row = np.nonzero(turned < reach_heading)
        return shift, close[row]

    def near_all(
        self, poses: np.ndarray, reach: np.ndarray, reach_heading: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`near` for poses [P, 3], each with its reaches [P].

        Returns:
            the numbers [n] of the poses, in order; the sector shifts [n] and keyframes [n].
        """
        x, y, heading = self.poses.T
        apart = (x - poses[:, :1]) ** 2 + (y - poses[:, 1:2]) ** 2
        one, frame = np.nonzero(apart < reach[:, None] ** 2)
        turned = np.abs(wrap(heading[frame, None] + self.turns - poses[one, 2:]))
        row, shift = np.nonzero(turned < reach_heading[one, None])
        return one[row], shift, frame[row]

    def best_match(self, pose: np.ndarray, gain: np.ndarray) -> Match | None:
        """Where a view with gains [S, N or more] fits best of what a robot at `pose` [3] is compared with;
        None where it fits nothing better than a new place."""
        shift, frame = self.near(pose, self.reach, self.reach_heading)
        gains = gain[shift, frame]
        if not (gains > 0).any():
            return None
        best = int(np.argmax(gains))
        return Match(int(shift[best]), int(frame[best]), float(gains[best]))

    def is_near(self, pose: np.ndarray) -> bool:
        """Whether a robot at `pose` [3] is so near a keyframe that its view counts by its gain."""
        share = self.near_share
        return len(self.near(pose, share * self.reach, share * self.reach_heading)[0]) > 0

    def is_passed(self, pose: np.ndarray) -> bool:
        """Whether a keyframe is within reach of `pose` [3], whatever its heading."""
        return bool(np.hypot(*(self.poses[:, :2] - pose[:2]).T).min() < self.reach)

    def claims(self, shift: np.ndarray, frame: np.ndarray) -> np.ndarray:
        """[n, 3] poses of a robot whose view is that of keyframes [n] at sector shifts [n]."""
        claimed = self.poses[frame].copy()
        claimed[:, 2] = wrap(claimed[:, 2] + self.turns[shift])
        return claimed

    def places(self) -> float:
        """Number of poses that can be told apart: keyframes within reach of each other count as one."""
        density = [len(self.near(pose, self.reach, self.reach_heading)[0]) for pose in self.poses]
        return float((len(self.turns) / np.maximum(density, 1)).sum())


DEVIATIONS = 2.0
"""Standard deviations of a pose hypothesis by which the reach of the ground grows."""
MOST_REACH, MOST_REACH_HEADING = 3.0, 2.0
"""Largest reaches, as multiples of those of the ground."""


class PoseHypothesis(NamedTuple):
    """A pose hypothesis in the map: mean [3] m, m, rad; covariance [3, 3]. Or P of them: [P, 3] and
    [P, 3, 3]."""

    pose: np.ndarray
    covariance: np.ndarray

    def is_comparable(self, ground: Ground) -> bool:
        """Whether the pose is so well known that all keyframes it may be at are compared with it."""
        position, heading = self.deviations()
        reach_heading = MOST_REACH_HEADING * ground.reach_heading
        return DEVIATIONS * position <= MOST_REACH * ground.reach and DEVIATIONS * heading <= reach_heading

    def log_share(self, ground: Ground, pose: np.ndarray) -> float:
        """Logarithm of the probability that the robot is at `pose` [3], as far as views can tell it from
        others."""
        error = pose - self.pose
        error[2] = wrap(error[2])
        spread = self.covariance + np.diag(ground.variance)
        _, volume = np.linalg.slogdet(spread)
        return float(np.log(ground.variance).sum() - volume - error @ np.linalg.solve(spread, error)) / 2

    def moved(self, by: Motion) -> PoseHypothesis:
        """The pose moved by odometry, to first order in its noise (Smith and Cheeseman 1986)."""
        if not by.motion.any() and not by.variance.any():
            return self
        turn, lever = np.zeros((2, *self.covariance.shape))
        turn[..., 0, 0] = turn[..., 1, 1] = np.cos(self.pose[..., 2])
        turn[..., 1, 0] = np.sin(self.pose[..., 2])
        turn[..., 0, 1], turn[..., 2, 2] = -turn[..., 1, 0], 1.0
        ahead = turn @ by.motion
        lever[..., range(3), range(3)] = 1.0
        lever[..., 0, 2], lever[..., 1, 2] = -ahead[..., 1], ahead[..., 0]
        covariance = lever @ self.covariance @ np.swapaxes(lever, -1, -2)
        covariance += (turn * by.variance) @ np.swapaxes(turn, -1, -2)
        return PoseHypothesis(compose(self.pose, by.motion), covariance)

    def deviations(self) -> tuple[float, float]:
        """Standard deviations: of the position in the direction where it is largest, m; of the heading,
        rad."""
        (xx, xy), (_, yy) = self.covariance[:2, :2].tolist()
        largest = (xx + yy) / 2 + math.hypot((xx - yy) / 2, xy)
        return math.sqrt(largest), math.sqrt(self.covariance[2, 2])


class Motion(NamedTuple):
    """Odometry between consecutive keyframes of a session: motion [3] without its systematic errors, m, m,
    rad, and variance [3]."""

    motion: np.ndarray
    variance: np.ndarray

    def reversed(self) -> Motion:
        """The same driven backwards."""
        return Motion(inverse(self.motion), self.variance)


NO_MOTION = Motion(np.zeros(3), np.zeros(3))


def advance(
    ground: Ground, at: PoseHypothesis, moved: Motion, gain: np.ndarray | None
) -> tuple[PoseHypothesis, float | None]:
    """Moves a pose hypothesis, and corrects it by the keyframes near by, weighted by how well their views
    fit.

    Args:
        gain: [S, N] log-likelihood of the newest view at each keyframe less that at a new place, nat; None
            if it shows nothing.

    Returns:
        the pose thereafter; the gain of the best keyframe near by, nat, NaN where no keyframe is near, None
        of a view that shows nothing.
    """
    at = at.moved(moved)
    if gain is None:
        return at, None
    shift, frame = ground.near(at.pose, *_reaches(ground, *at.deviations()))
    if not len(frame):
        return at, np.nan
    gains = gain[shift, frame].astype(float)
    best = float(gains.max())
    if best <= 0:
        return at, best
    weight = np.exp(gains - best)
    error = ground.claims(shift, frame) - at.pose
    error[:, 2] = wrap(error[:, 2])
    # The Kalman filter's update by the mean of the differences.
    share = np.linalg.solve((at.covariance + np.diag(ground.variance)).T, at.covariance.T).T
    pose = at.pose + share @ ((weight / weight.sum()) @ error)
    pose[2] = wrap(pose[2])
    covariance = at.covariance - share @ at.covariance
    return PoseHypothesis(pose, (covariance + covariance.T) / 2), best


def advance_all(
    ground: Ground, at: PoseHypothesis, moved: Motion, gain: np.ndarray
) -> tuple[PoseHypothesis, np.ndarray]:
    """`advance` for P pose hypotheses that move alike, and the gains [P], nat. Most of many poses fit
    nowhere: only the others are corrected, one by one."""
    pose, covariance = (each.copy() for each in at.moved(moved))
    (xx, xy, _), (_, yy, _), (*_, heading) = np.moveaxis(covariance, 0, -1)
    position = np.sqrt((xx + yy) / 2 + np.hypot((xx - yy) / 2, xy))
    one, shift, frame = ground.near_all(pose, *_reaches(ground, position, np.sqrt(heading)))
    best = np.full(len(pose), np.nan)
    near, first = np.unique(one, return_index=True)
    if len(near):
        best[near] = np.maximum.reduceat(gain[shift, frame].astype(float), first)
    for k in np.flatnonzero(best > 0).tolist():
        corrected, _ = advance(ground, PoseHypothesis(at.pose[k], at.covariance[k]), moved, gain)
        pose[k], covariance[k] = corrected
    return PoseHypothesis(pose, covariance), best


@compiled
def grown_reaches(reach: float, reach_heading: float, place: float, heading: float) -> tuple[float, float]:
    """The reaches, m and rad, of a pose with these variances of position and heading, from those of the
    ground; for compiled loops."""
    far = min(reach + DEVIATIONS * np.sqrt(place), MOST_REACH * reach)
    return far, min(reach_heading + DEVIATIONS * np.sqrt(heading), MOST_REACH_HEADING * reach_heading)


def _reaches(ground: Ground, position: Any, heading: Any) -> tuple[Any, Any]:
    """The reaches, m and rad, of a pose with these standard deviations."""
    reach = np.minimum(ground.reach + DEVIATIONS * position, MOST_REACH * ground.reach)
    most = MOST_REACH_HEADING * ground.reach_heading
    return reach, np.minimum(ground.reach_heading + DEVIATIONS * heading, most)


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
"""Log-odds of leaving mapped ground: false pose hypotheses do so more often than true ones."""


GainPrior = tuple[tuple[float, float], tuple[float, float]]
"""Gains before any were counted: mean and standard deviation at true and at false poses, nat."""


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


PRIOR: GainPrior = ((1.9, 0.8), (0.5, 1.6))
"""Of plain gains."""


def learn_gain_odds(true: np.ndarray, false: np.ndarray, prior: GainPrior = PRIOR) -> GainOdds:
    """Log-odds of gains from those counted at true poses [n] and at false ones [m]."""
    from scipy.optimize import isotonic_regression  # slow to import
    from scipy.special import ndtri

    # Both distributions of the prior as evenly spread quantiles.
    share = (np.arange(64) + 0.5) / 64
    prior_true, prior_false = (mean + deviation * ndtri(share) for mean, deviation in prior)
    pooled = np.concatenate([true, false, prior_true, prior_false])
    low, high = np.clip(np.quantile(pooled, [0.005, 0.995]), -FARTHEST, FARTHEST).tolist()
    edges = np.linspace(low, high, BINS - 1)
    same, other = _density(edges, true, prior_true), _density(edges, false, prior_false)
    mixed_same = (1 - OUTLIERS) * same + OUTLIERS * other
    mixed_other = (1 - OUTLIERS) * other + OUTLIERS * same
    tiny = np.finfo(float).tiny  # a bin without counts has no odds
    raw = np.log((mixed_same + tiny) / (mixed_other + tiny))
    # A better fit is never evidence against a place; bins without gains say little.
    odds = isotonic_regression(raw, weights=same + other + 1e-6).x
    return GainOdds(edges, odds, float(same @ odds))


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
        self._append_row(ground, *found)
        return found

    def arrays(self) -> dict[str, np.ndarray]:
        return super().arrays() if len(self.ground.rows) else {}

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        if arrays:
            super().restore(arrays)
        else:
            self._take_rows(slice(0))


COMMON = 0.5
"""Factor on the logarithm of a view's mean likelihood over the whole ground, subtracted from its gains."""
PIECE_COMMON = 0.25
"""The same factor for a piece of a growing map."""


class GainWeighting(NamedTuple):
    """Attributes:
    weigh: from gains [..., S, N] of views on a whole ground to those that are counted. prior: of these.
    matching: mean of those before one above which a false pose still looks right, nat.
    """

    weigh: Callable[[np.ndarray], np.ndarray]
    prior: GainPrior
    matching: float


def less_where_common(gain: np.ndarray, share: float = COMMON) -> np.ndarray:
    """Gains [..., S, N] of views on a ground, less where the whole ground fits a view: a view that fits
    many places, or any wall, tells little of where the robot is, nor whether it is on this ground. A full
    Bayes filter would divide by the mean likelihood."""
    most = gain.max(axis=(-2, -1), keepdims=True, initial=-np.inf)
    mean = np.exp(gain - most).mean(axis=(-2, -1), keepdims=True)
    return gain - share * (most + np.log(mean))


MAP_WEIGHTING = GainWeighting(np.asarray, PRIOR, 1.0)
"""For two pieces of finished maps, of which many keyframes are compared."""
PIECE_WEIGHTING = GainWeighting(partial(less_where_common, share=PIECE_COMMON), ((2.4, 0.8), (1.0, 1.6)), 1.5)
"""For the newest piece of a growing map."""
SESSION_WEIGHTING = GainWeighting(less_where_common, ((2.95, 0.8), (1.55, 1.6)), 2.0)
"""For a session of which few keyframes are known."""
