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
from tactile.base.compiled import compiled, wrapped
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
        position, heading = self.variances()
        return math.sqrt(position), math.sqrt(heading)

    def variances(self) -> tuple[Any, Any]:
        """The squares of `deviations`, m², rad²."""
        (xx, xy, _), (_, yy, _), (*_, heading) = np.moveaxis(self.covariance, (-2, -1), (0, 1))
        return (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy), heading


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
    reaches = _grown_reaches(ground.reach, ground.reach_heading, *at.variances())
    best, *off = compare_view(ground.poses, ground.turns, gain.astype(float), at.pose, *reaches)
    return (_corrected(ground, at, np.array(off)) if best > 0 else at), best


def advance_all(
    ground: Ground, at: PoseHypothesis, moved: Motion, gain: np.ndarray
) -> tuple[PoseHypothesis, np.ndarray]:
    """`advance` for P pose hypotheses that move alike, and the gains [P], nat. Most of many poses fit
    nowhere: only the others are corrected, one by one."""
    pose, covariance = (each.copy() for each in at.moved(moved))
    spread, gain = PoseHypothesis(pose, covariance).variances(), gain.astype(float)
    best, off = _compare_at_all(
        ground.poses, ground.turns, gain, pose, *spread, ground.reach, ground.reach_heading
    )
    for k in np.flatnonzero(best > 0).tolist():
        pose[k], covariance[k] = _corrected(ground, PoseHypothesis(pose[k], covariance[k]), off[k])
    return PoseHypothesis(pose, covariance), best


def _corrected(ground: Ground, at: PoseHypothesis, off: np.ndarray) -> PoseHypothesis:
    """The Kalman filter's update by the mean difference [3] of the poses that a view claims."""
    share = np.linalg.solve((at.covariance + np.diag(ground.variance)).T, at.covariance.T).T
    pose = at.pose + share @ off
    pose[2] = wrap(pose[2])
    covariance = at.covariance - share @ at.covariance
    return PoseHypothesis(pose, (covariance + covariance.T) / 2)


LEAVING = -2.0
"""Log-odds of leaving mapped ground: false pose hypotheses do so more often than true ones."""
WINDOW = 15
"""Newest views of a track by which it is known as lost."""


@compiled
def _grown_reaches(reach: float, reach_heading: float, place: float, heading: float) -> tuple[float, float]:
    """The reaches, m and rad, of a pose with these variances of position and heading, from those of the
    ground."""
    far = min(reach + DEVIATIONS * np.sqrt(place), MOST_REACH * reach)
    return far, min(reach_heading + DEVIATIONS * np.sqrt(heading), MOST_REACH_HEADING * reach_heading)


@compiled
def compare_view(
    poses: np.ndarray, turns: np.ndarray, gain: np.ndarray, pose: np.ndarray, reach: float, turn: float
) -> tuple[float, float, float, float]:
    """The best gain [S, N] of a view at the keyframes within `reach` (m) and `turn` (rad) of a pose [3], NaN
    without any, and the mean difference from it of the poses that they claim, weighted by the likelihoods
    (m, m, rad)."""
    best, total, dx, dy, da = -np.inf, 0.0, 0.0, 0.0, 0.0
    for i in range(len(poses)):
        x, y = poses[i, 0] - pose[0], poses[i, 1] - pose[1]
        if x * x + y * y >= reach * reach:
            continue
        for s in range(len(turns)):
            fit = gain[s, i]
            if fit == -np.inf:
                continue
            angle = wrapped(poses[i, 2] + turns[s] - pose[2])
            if abs(angle) >= turn:
                continue
            if fit > best:
                scale = np.exp(best - fit)
                total, dx, dy, da, best = total * scale, dx * scale, dy * scale, da * scale, fit
            weight = np.exp(fit - best)
            total, dx, dy, da = total + weight, dx + weight * x, dy + weight * y, da + weight * angle
    if total == 0.0:
        return np.nan, 0.0, 0.0, 0.0
    return best, dx / total, dy / total, da / total


@compiled
def _compare_at_all(
    poses: np.ndarray, turns: np.ndarray, gain: np.ndarray, at: np.ndarray, place: np.ndarray,
    heading: np.ndarray, reach: float, reach_heading: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """`compare_view` at each of the poses [P, 3] with variances [P] of position and heading."""
    best, off = np.empty(len(at)), np.empty((len(at), 3))
    for k in range(len(at)):
        near, turn = _grown_reaches(reach, reach_heading, place[k], heading[k])
        best[k], off[k, 0], off[k, 1], off[k, 2] = compare_view(poses, turns, gain, at[k], near, turn)
    return best, off


@compiled
def move_pose(pose: np.ndarray, motion: np.ndarray) -> None:
    """Moves a pose [3] by a motion [3]."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    pose[0], pose[1] = pose[0] + c * motion[0] - s * motion[1], pose[1] + s * motion[0] + c * motion[1]
    pose[2] = wrapped(pose[2] + motion[2])


@compiled
def follow_track(
    ground: np.ndarray, turns: np.ndarray, gains: np.ndarray, frames: np.ndarray, motions: np.ndarray,
    variances: np.ndarray, spread: np.ndarray, reach: float, reach_heading: float, edges: np.ndarray,
    odds: np.ndarray, least: float, start: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """`advance` from view to view with variances of position and heading alone, in one compiled loop because
    hundreds of tracks are followed.

    Args:
        ground: [N, 3] poses of the keyframes. gains: [M, S, N] of all views. frames: [n] the views that are
            followed. motions, variances: [n, 3] of the odometry into each. spread: [3] variance of a pose
            found by comparing views, and of `start` [3]. edges, odds: see `GainOdds`. least: log-odds of the
            last `WINDOW` views below which a track ends.

    Returns:
        poses [n, 3] before and after each view; the best gain [n], NaN where no keyframe is near; log-odds
        [n] of the views.
    """
    count = len(frames)
    before, after, best, gained = np.empty((count, 3)), np.empty((count, 3)), np.empty(count), np.empty(count)
    pose, place, heading = start.copy(), spread[0], spread[2]  # with its variances
    inside, recent = True, 0.0
    for k in range(count):
        move_pose(pose, motions[k])
        place += variances[k, 0] + heading * (motions[k, 0] ** 2 + motions[k, 1] ** 2)
        heading += variances[k, 2]
        before[k] = pose
        near, turn = _grown_reaches(reach, reach_heading, place, heading)
        best[k], dx, dy, da = compare_view(ground, turns, gains[frames[k]], pose, near, turn)
        if best[k] > 0:
            share, turned = place / (place + spread[0]), heading / (heading + spread[2])
            pose[0], pose[1] = pose[0] + share * dx, pose[1] + share * dy
            pose[2] = wrapped(pose[2] + turned * da)
            place, heading = place * (1 - share), heading * (1 - turned)
        after[k] = pose
        if np.isnan(best[k]):
            gained[k] = LEAVING if inside else 0.0
        else:
            gained[k] = odds[np.searchsorted(edges, best[k])]
        inside = not np.isnan(best[k])
        recent += gained[k] - (gained[k - WINDOW] if k >= WINDOW else 0.0)
        if recent < least:
            count = k + 1
            break
    return before[:count], after[:count], best[:count], gained[:count]


BINS = 24
"""Number of bins of the gain."""
PRIOR_COUNT = 40.0
"""Number of gains that the prior counts as."""
FARTHEST = 20.0
"""Largest absolute value of the limits between bins, nat: gains beyond are certain, and finer bins tell
more."""
OUTLIERS = 0.04
"""Share of either distribution that is drawn from the other: something has changed, or was misread."""
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


EVEN = GainOdds(np.arange(BINS - 1.0), np.zeros(BINS), 0.0)
"""Odds that say nothing."""
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
