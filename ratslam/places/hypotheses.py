"""Supposed poses of a session in a map, each with the log-odds of the whole session since its start.

Recall proposes poses. A proposed pose is followed back to the start of the session, and from then on with
it: it has to explain all views, not only those that proposed it. The rule is ours; localisation with an
unknown start by hypotheses is Fox et al. 1999.

Log-odds of a pose that is right although its views contradict the map for a while: the place has changed.

A hidden Markov model with a state in which the views agree, and a changed state of bounded length in which
they are as likely as at the other place that they resemble most. A short contradiction costs its prior,
however strong it is; one that lasts, or views of another known place, are those of a wrong pose. The model is
ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.core.checkpoint import Checkpointed
from ratslam.core.growable_array import GrowableArray
from ratslam.mapping.following import Motion, Supposed, advance
from ratslam.mapping.gain_odds import GainOdds
from ratslam.mapping.ground import Ground
from ratslam.places.paths import Path, follow, keyframe_odds
from tactile.base.se2 import wrap

SPAN = 400
"""Largest number of keyframes of the session that a proposed pose is followed back."""
HOPELESS = -25.0
"""Log-odds below which a supposed pose is dropped."""
SAME_HEADING = 0.5
"""Difference in heading within which two supposed poses are the same, rad; in position it is the ground's
reach."""


class Recalled(NamedTuple):
    """The pose [3] at which recall places the newest keyframe, m, m, rad, and its gain there, nat."""

    pose: np.ndarray
    gain: float


class SessionViews(Checkpointed):
    """The newest keyframes of a session: odometry into each, and the gains of their views on the ground.

    Args:
        shifts, count: S and N of the ground.
    """

    def __init__(self, shifts: int, count: int) -> None:
        self.gain = GrowableArray((shifts, count), np.float32)
        self.shows = GrowableArray((), np.bool_)
        self.motion = GrowableArray((3,), np.float64)
        self.variance = GrowableArray((3,), np.float64)

    @property
    def count(self) -> int:
        """Number of keyframes."""
        return len(self.shows.rows)

    def append(self, moved: Motion, gain: np.ndarray | None) -> None:
        """Adds a keyframe; the oldest ones are forgotten."""
        if self.count >= 2 * SPAN:
            self.forget(SPAN)
        empty = np.zeros(self.gain.rows.shape[1:], np.float32)
        self.gain.append(empty if gain is None else gain)
        self.shows.append(gain is not None)
        self.motion.append(moved.motion)
        self.variance.append(moved.variance)

    def forget(self, keep: int) -> None:
        """Forgets all but the newest keyframes."""
        for array in (self.gain, self.shows, self.motion, self.variance):
            array.replace(array.rows[max(len(array.rows) - keep, 0) :].copy())

    def moved(self, k: int) -> Motion:
        """The odometry into keyframe k."""
        return Motion(self.motion.rows[k], self.variance.rows[k])

    def gains(self, k: int) -> np.ndarray | None:
        """[S, N] gains of the view of keyframe k, None if it shows nothing."""
        return self.gain.rows[k] if self.shows.rows[k] else None

    def follow_back(self, ground: Ground, odds: GainOdds, at: Supposed, least: float = -np.inf) -> Path:
        """The path to a supposed pose of the newest keyframe, from the newest to the oldest keyframe; ends
        early once its log-odds are below `least`."""
        keyframes = range(self.count - 2, max(self.count - 1 - SPAN, -1), -1)
        back = ((self.moved(k + 1).reversed(), self.gains(k)) for k in keyframes)
        return follow(ground, odds, at, back, least)


class Hypotheses(Checkpointed):
    """Attributes:
    pose: [h, 3], covariance: [h, 3, 3] of each supposed pose now. log_odds: [h] of the session so far.
    states: [h, 1 + LONGEST] log-odds since it was proposed if the ground may have changed, see
        `interruptions`. best: [h] the largest sum of these so far. inside: [h] bool, on mapped ground.
    """

    def __init__(self) -> None:
        self.pose = GrowableArray((3,), np.float64)
        self.covariance = GrowableArray((3, 3), np.float64)
        self.log_odds = GrowableArray((), np.float64)
        self.states = GrowableArray((1 + LONGEST,), np.float64)
        self.best = GrowableArray((), np.float64)
        self.inside = GrowableArray((), np.bool_)

    @property
    def count(self) -> int:
        """Number of supposed poses."""
        return len(self.log_odds.rows)

    def at(self, k: int) -> Supposed:
        """A supposed pose."""
        return Supposed(self.pose.rows[k], self.covariance.rows[k])

    def advance(
        self,
        ground: Ground,
        odds: GainOdds,
        moved: Motion,
        gain: np.ndarray | None,
        recalled: Recalled | None = None,
    ) -> None:
        """Moves all supposed poses to the newest keyframe; drops hopeless ones, and the weaker of two that
        have become one."""
        log_odds = np.zeros(self.count)
        for k in range(self.count):
            at, gained = advance(ground, self.at(k), moved, gain)
            log_odds[k], inside = keyframe_odds(ground, odds, at.pose, gained, bool(self.inside.rows[k]))
            self.pose.rows[k], self.covariance.rows[k] = at
            self.inside.rows[k] = inside
        self.log_odds.rows[:] += log_odds
        elsewhere = np.zeros(self.count)
        if recalled is not None:
            another = ~same_pose(ground, self.pose.rows, recalled.pose)
            elsewhere = np.where(another, max(odds.of(recalled.gain), 0.0), 0.0)
        self.states.rows[:] = continue_states(self.states.rows, log_odds, elsewhere)
        self.best.rows[:] = np.maximum(self.best.rows, summed(self.states.rows))
        self._drop(ground)

    def propose(self, ground: Ground, odds: GainOdds, views: SessionViews, pose: np.ndarray) -> None:
        """Adds a supposed pose [3] of the newest keyframe, with the log-odds of its own way back to the start
        of the session, unless there is one like it."""
        if same_pose(ground, self.pose.rows, pose).any():
            return
        at = Supposed(pose, np.diag(ground.variance))
        self._add_unless_hopeless(at, float(views.follow_back(ground, odds, at, HOPELESS).odds.sum()))

    def continue_uncertain(self, ground: Ground, odds: GainOdds, recalled: Recalled) -> None:
        """Supposes the recalled pose if it continues another one, which odometry has made uncertain: with the
        log-odds of the likeliest of these, of being here, and of the view."""
        uncertain = [k for k in range(self.count) if not self.at(k).is_comparable(ground)]
        if not uncertain:
            return
        here = [self.log_odds.rows[k] + self.at(k).log_share(ground, recalled.pose) for k in uncertain]
        log_odds = float(max(here)) + odds.of(recalled.gain)
        same = np.flatnonzero(same_pose(ground, self.pose.rows, recalled.pose))
        same = np.setdiff1d(same, uncertain)
        if len(same):
            self.log_odds.rows[same] = np.maximum(self.log_odds.rows[same], log_odds)
        else:
            self._add_unless_hopeless(Supposed(recalled.pose, np.diag(ground.variance)), log_odds)

    def _add_unless_hopeless(self, at: Supposed, log_odds: float) -> None:
        if log_odds >= HOPELESS:
            self.add(at, log_odds)

    def add(self, at: Supposed, log_odds: float) -> None:
        """Adds a supposed pose of the newest keyframe with the log-odds of the session so far."""
        self.pose.append(at.pose)
        self.covariance.append(at.covariance)
        self.log_odds.append(log_odds)
        self.states.append(uninterrupted(1)[0])
        self.best.append(0.0)
        self.inside.append(True)

    def clear(self) -> None:
        """Drops all."""
        self._keep(np.zeros(self.count, bool))

    def fall(self, k: int) -> float:
        """By how much the log-odds of a supposed pose are below their best, changed ground allowed for."""
        return float(self.best.rows[k] - summed(self.states.rows[k : k + 1])[0])

    def ranked(self) -> np.ndarray:
        """[h] the supposed poses by descending log-odds."""
        return np.argsort(-self.log_odds.rows, kind="stable")

    def _drop(self, ground: Ground) -> None:
        kept: list[int] = []
        for k in self.ranked().tolist():
            hopeless = self.log_odds.rows[k] < HOPELESS
            if not hopeless and not same_pose(ground, self.pose.rows[kept], self.pose.rows[k]).any():
                kept.append(k)
        if len(kept) < self.count:
            self._keep(np.isin(np.arange(self.count), kept))

    def _keep(self, rows: np.ndarray) -> None:
        for array in (self.pose, self.covariance, self.log_odds, self.states, self.best, self.inside):
            array.replace(array.rows[rows].copy())


def same_pose(ground: Ground, poses: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """[n] bool: poses [n, 3] that are the same place and heading as `pose` [3]."""
    apart = np.hypot(*(poses - pose)[:, :2].T)
    return (apart < ground.reach) & (np.abs(wrap(poses[:, 2] - pose[2])) < SAME_HEADING)


LONGEST = 12
"""Longest stretch of changed ground, keyframes."""
SHARE = 1e-4
"""Share of keyframes at which such a stretch begins; each length is as likely as another."""


def uninterrupted(count: int) -> np.ndarray:
    """[count, 1 + LONGEST] log-odds of poses at which all views agreed: of agreement, and of a changed
    stretch that lasts 1, 2, ... more keyframes."""
    states = np.full((count, 1 + LONGEST), -np.inf)
    states[:, 0] = 0.0
    return states


def continue_states(states: np.ndarray, odds: np.ndarray, elsewhere: np.ndarray) -> np.ndarray:
    """The log-odds [n, 1 + LONGEST] after one more keyframe.

    Args:
        odds: [n] log-odds of its view. elsewhere: [n] those at another place like it, 0 without one.
    """
    agrees, changed = states[:, 0], states[:, 1:]
    following = np.empty_like(states)
    following[:, 0] = np.logaddexp(agrees + np.log1p(-SHARE), changed[:, 0]) + odds
    following[:, 1:] = agrees[:, None] + np.log(SHARE / LONGEST)
    following[:, 1:-1] = np.logaddexp(following[:, 1:-1], changed[:, 1:])
    following[:, 1:] -= elsewhere[:, None]
    return following


def summed(states: np.ndarray) -> np.ndarray:
    """[n] log-odds of the poses, whether interrupted now or not."""
    return np.logaddexp.reduce(states, axis=1)
