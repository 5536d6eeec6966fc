"""Pose hypotheses of a session in a map, each with the log-odds of the whole session since its start.

Recall proposes poses. A proposed pose is followed back to the start of the session, and from then on with it:
it has to explain all views, not only those that proposed it (localisation with an unknown start by
hypotheses: Fox et al. 1999). A path is a pose followed through many keyframes.

A right pose may be contradicted for a while because the place has changed. A hidden Markov model has a state
in which the views agree, and a changed state of bounded length in which they are as likely as at the other
place that they resemble most. A short contradiction costs its prior, however strong it is; one that lasts, or
views of another known place, are those of a wrong pose.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.mapping.ground import LEAVING, GainOdds, Ground, Motion, PoseHypothesis, advance
from tactile.base.se2 import wrap

BESIDE = -1.0
"""Least log-odds of a view on ground that was driven, but not near the way: one or two in a hundred views of
a map's own revisits lie there, and three in ten of paths that only look alike."""
AGAIN = 6
"""Keyframes after which a path that comes back to a place visits it again."""
AGAIN_SHARE = 0.5
"""Share of the evidence for a path that counts there."""
BESIDE_SHARE = 0.3
"""Share of the evidence against a path that counts beside the way after the first such keyframe of a run."""


Onwards = Iterable[tuple[Motion, np.ndarray | None]]
"""The motion into each further keyframe, and the gains [S, N] of its view, None if it shows nothing."""


class Path(NamedTuple):
    """A pose hypothesis followed through n keyframes: poses [n, 3], m, m, rad, and log-odds [n] of each
    keyframe, nat; `first`: the number of the first one in its session."""

    poses: np.ndarray
    odds: np.ndarray
    first: int = 0

    def passes(self, ground: Ground, k: int, pose: np.ndarray) -> bool:
        """Whether keyframe k of the session is at `pose` [3]."""
        row = k - self.first
        inside = 0 <= row < len(self.poses)
        return inside and bool(same_pose(ground, self.poses[row : row + 1], pose)[0])

    def odds_beside(self, ground: Ground) -> np.ndarray:
        """[n] the log-odds of each keyframe, nat; of those in a run beside the driven way, less after the
        first: a path beside the way stays there for some keyframes, and the map may be bent there."""
        beside = np.array([ground.is_passed(pose) and not ground.is_near(pose) for pose in self.poses])
        still = beside & np.concatenate([[False], beside[:-1]])
        return np.where(still & (self.odds < 0), BESIDE_SHARE * self.odds, self.odds)

    def at_undriven_headings(self, ground: Ground) -> np.ndarray:
        """[n] bool: on the driven way, but at no heading that was driven there, so that a right pose and a
        wrong one may both look unlike it."""
        near = np.array([ground.is_near(pose) for pose in self.poses])
        apart = np.array([np.hypot(*(ground.poses[:, :2] - pose[:2]).T).min() for pose in self.poses])
        return ~near & (apart < ground.near_share * ground.reach)

    def independent_odds(self, ground: Ground) -> np.ndarray:
        """[n] the log-odds of each keyframe, nat, less where an earlier keyframe gave nearly the same
        evidence.

        A place elsewhere that is alike is alike at each visit, and often from every heading; one that is not,
        contradicts at each.
        """
        apart = np.hypot(*(self.poses[:, None, :2] - self.poses[None, :, :2]).T)
        keyframe = np.arange(len(apart))
        earlier = keyframe[:, None] - keyframe >= AGAIN
        again = (earlier & (apart < ground.near_share * ground.reach)).any(axis=1)
        odds = self.odds_beside(ground)
        return np.where(again & (odds > 0), AGAIN_SHARE * odds, odds)


def follow(ground: Ground, odds: GainOdds, at: PoseHypothesis, way: Onwards, least: float = -np.inf) -> Path:
    """The path from a pose hypothesis on mapped ground; ends early once its log-odds are below `least`.

    Args:
        way: from there on, see `Onwards`.
    """
    poses, gained = [at.pose], [0.0]
    total, inside = 0.0, True
    for moved, gains in way:
        at, gain = advance(ground, at, moved, gains)
        log_odds, inside = keyframe_odds(ground, odds, at.pose, gain, inside)
        poses.append(at.pose)
        gained.append(log_odds)
        total += log_odds
        if total < least:
            break
    return Path(np.array(poses), np.array(gained))


def keyframe_odds(
    ground: Ground, odds: GainOdds, pose: np.ndarray, gain: float | None, inside: bool
) -> tuple[float, bool]:
    """Log-odds of one keyframe, nat, and whether it is on mapped ground.

    Args:
        pose: [3] of the hypothesis. gain: see `advance`.
        inside: whether the keyframe before is on mapped ground.
    """
    if gain is None:
        return 0.0, inside
    if ground.is_near(pose):
        return odds.of(gain), True
    if ground.is_passed(pose):
        return (BESIDE if np.isnan(gain) else min(max(odds.of(gain), BESIDE), 0.0)), inside
    if np.isnan(gain):
        return (LEAVING if inside else 0.0), False
    return 0.0, inside  # the pose is so uncertain that keyframes beyond the reach were compared


SPAN = 400
"""Largest number of keyframes of the session that a proposed pose is followed back."""
MIN_LOG_ODDS = -25.0
"""Log-odds below which a pose hypothesis is dropped."""
SAME_HEADING = 0.5
"""Difference in heading within which two hypotheses are the same, rad; in position it is the ground's
reach."""


Recalled = tuple[np.ndarray, float]
"""The pose [3] at which recall places the newest keyframe, m, m, rad, and its gain there, nat."""


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
        self._append_row(empty if gain is None else gain, gain is not None, *moved)

    def forget(self, keep: int) -> None:
        """Forgets all but the newest keyframes."""
        self._take_rows(slice(max(self.count - keep, 0), None))

    def moved(self, k: int) -> Motion:
        """The odometry into keyframe k."""
        return Motion(self.motion.rows[k], self.variance.rows[k])

    def gains(self, k: int) -> np.ndarray | None:
        """[S, N] gains of the view of keyframe k, None if it shows nothing."""
        return self.gain.rows[k] if self.shows.rows[k] else None

    def follow_back(self, ground: Ground, odds: GainOdds, at: PoseHypothesis, least: float = -np.inf) -> Path:
        """The path to a pose hypothesis of the newest keyframe, from the newest to the oldest keyframe; ends
        early once its log-odds are below `least`."""
        keyframes = range(self.count - 2, max(self.count - 1 - SPAN, -1), -1)
        back = ((self.moved(k + 1).reversed(), self.gains(k)) for k in keyframes)
        return follow(ground, odds, at, back, least)


class Hypotheses(Checkpointed):
    """Attributes:
    pose: [h, 3], covariance: [h, 3, 3] of each hypothesis now. log_odds: [h] of the session so far.
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
        """Number of hypotheses."""
        return len(self.log_odds.rows)

    def at(self, k: int) -> PoseHypothesis:
        """A pose hypothesis."""
        return PoseHypothesis(self.pose.rows[k], self.covariance.rows[k])

    def advance(
        self, ground: Ground, odds: GainOdds, step: Motion, gain: np.ndarray | None, recalled: Recalled | None
    ) -> None:
        """Moves all hypotheses to the newest keyframe; drops unlikely ones, and the weaker of two that
        have become one."""
        log_odds = np.zeros(self.count)
        for k in range(self.count):
            at, gained = advance(ground, self.at(k), step, gain)
            log_odds[k], inside = keyframe_odds(ground, odds, at.pose, gained, bool(self.inside.rows[k]))
            self.pose.rows[k], self.covariance.rows[k] = at
            self.inside.rows[k] = inside
        self.log_odds.rows[:] += log_odds
        elsewhere = np.zeros(self.count)
        if recalled is not None:
            pose, recalled_gain = recalled
            another = ~same_pose(ground, self.pose.rows, pose)
            elsewhere = np.where(another, max(odds.of(recalled_gain), 0.0), 0.0)
        self.states.rows[:] = continue_states(self.states.rows, log_odds, elsewhere)
        self.best.rows[:] = np.maximum(self.best.rows, summed(self.states.rows))
        kept: list[int] = []
        for k in self.ranked().tolist():
            likely = self.log_odds.rows[k] >= MIN_LOG_ODDS
            if likely and not same_pose(ground, self.pose.rows[kept], self.pose.rows[k]).any():
                kept.append(k)
        if len(kept) < self.count:
            self._take_rows(np.isin(np.arange(self.count), kept))

    def propose(self, ground: Ground, odds: GainOdds, views: SessionViews, pose: np.ndarray) -> None:
        """Adds a pose hypothesis [3] of the newest keyframe, with the log-odds of its own way back to the
        start of the session, unless there is one like it."""
        if same_pose(ground, self.pose.rows, pose).any():
            return
        at = PoseHypothesis(pose, np.diag(ground.variance))
        self.add(at, float(views.follow_back(ground, odds, at, MIN_LOG_ODDS).odds.sum()))

    def continue_uncertain(self, ground: Ground, odds: GainOdds, recalled: Recalled) -> None:
        """Adds the recalled pose if it continues another one, which odometry has made uncertain: with the
        log-odds of the likeliest of these, of being here, and of the view."""
        uncertain = [k for k in range(self.count) if not self.at(k).is_comparable(ground)]
        if not uncertain:
            return
        pose, gain = recalled
        here = [self.log_odds.rows[k] + self.at(k).log_share(ground, pose) for k in uncertain]
        log_odds = float(max(here)) + odds.of(gain)
        same = np.flatnonzero(same_pose(ground, self.pose.rows, pose))
        same = np.setdiff1d(same, uncertain)
        if len(same):
            self.log_odds.rows[same] = np.maximum(self.log_odds.rows[same], log_odds)
        else:
            self.add(PoseHypothesis(pose, np.diag(ground.variance)), log_odds)

    def add(self, at: PoseHypothesis, log_odds: float) -> None:
        """Adds a pose hypothesis of the newest keyframe with the log-odds of the session so far, unless these
        are too low."""
        if log_odds < MIN_LOG_ODDS:
            return
        self._append_row(*at, log_odds, NOTHING_CHANGED, 0.0, True)

    def clear(self) -> None:
        """Drops all."""
        self._take_rows(slice(0))

    def fall(self, k: int) -> float:
        """By how much the log-odds of a pose hypothesis are below their best, changed ground allowed for."""
        return float(self.best.rows[k] - summed(self.states.rows[k : k + 1])[0])

    def ranked(self) -> np.ndarray:
        """[h] the hypotheses by descending log-odds."""
        return np.argsort(-self.log_odds.rows, kind="stable")


def same_pose(ground: Ground, poses: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """[n] bool: poses [n, 3] that are the same place and heading as `pose` [3]."""
    apart = np.hypot(*(poses - pose)[:, :2].T)
    return (apart < ground.reach) & (np.abs(wrap(poses[:, 2] - pose[2])) < SAME_HEADING)


LONGEST = 12
"""Longest stretch of changed ground, keyframes."""
SHARE = 1e-4
"""Share of keyframes at which such a stretch begins; each length is as likely as another."""


NOTHING_CHANGED = np.array([0.0] + [-np.inf] * LONGEST)
"""Log-odds of a pose at which all views agreed: of agreement, and of a changed stretch that lasts 1, 2, ...
more keyframes."""


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
