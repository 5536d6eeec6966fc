"""Where a session, or a piece of another map, is in a finished map: placements and their evidence.

Recall proposes a pose of one keyframe. It is followed by odometry and views (`hypotheses.follow`) through
the whole session, to its start and to its end: a placement has to explain all views, not only those that
proposed it. Its log-odds are the sum of those of all keyframes, as in multiple hypothesis localisation (Fox
et al. 1999, with hypotheses in place of particles). The keyframes on common ground then give loop closures.
A solved piece lies on the ground nearly as a rigid body: where the robot comes back from a way that the other
map does not have, its pose follows from all places confirmed so far, and not from a long way of odometry.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.mapping.ground import NO_MOTION, GainOdds, Ground, Match, Motion, PoseHypothesis, advance
from ratslam.places.hypotheses import MIN_LOG_ODDS, Path, follow, keyframe_odds, same_pose
from tactile.base.se2 import between, compose, fit_rigid_motion, inverse, wrap


class Comparison(NamedTuple):
    """The views of n keyframes of a session, in order of time, compared with a ground of N keyframes.

    Attributes:
        gain: [n, S, N] log-likelihood of each view at each sector shift and keyframe less that at a new
        place. shows: [n] bool, whether the view can be compared. match, shift: [n] the keyframe that is
        recalled, -1 for none, and the row of its sector shift. posterior: [n] of the places around it.
    """

    gain: np.ndarray
    shows: np.ndarray
    match: np.ndarray
    shift: np.ndarray
    posterior: np.ndarray

    def gains(self, k: int) -> np.ndarray | None:
        """[S, N] gains of one view, None if it shows nothing."""
        return self.gain[k] if self.shows[k] else None


CONFIRMING = 3
"""Keyframes after which a recalled pose has to agree with odometry before it is proposed."""


class _RecalledPose(NamedTuple):
    """Attributes:
    pose: [3] the newest recalled pose, moved on by odometry; NaN before any. agreeing: number of recalled
        poses in a row that agree with odometry. now: whether the newest keyframe was recalled.
    """

    pose: np.ndarray
    agreeing: int
    now: bool

    @property
    def is_confirmed(self) -> bool:
        """Whether the pose is to be proposed for the newest keyframe."""
        return self.now and self.agreeing >= CONFIRMING

    def onwards(self, ground: Ground, moved: Motion, shift: int, match: int, mass: float) -> _RecalledPose:
        """After the next keyframe, reached by `moved`, which recall places at keyframe `match` of the ground
        (-1: nowhere), turned by the sector shift of row `shift`, with this posterior `mass`."""
        expected = compose(self.pose, moved.motion)
        if match < 0 or mass <= 0.5:
            return _RecalledPose(expected, self.agreeing, False)
        pose = ground.claims(np.array([shift]), np.array([match]))[0]
        error = between(expected, pose)
        agrees = np.hypot(*error[:2]) < 2 * ground.reach and abs(error[2]) < ground.reach_heading
        return _RecalledPose(pose, self.agreeing + 1 if agrees else 1, True)


NOTHING_RECALLED = _RecalledPose(np.full(3, np.nan), 0, False)
"""Before the first keyframe."""


UNCONFIRMED = 6
"""Keyframes without evidence for a pose, after which it is that of the piece as a rigid body."""
TOGETHER = 20
"""Least number of keyframes with evidence for their poses that one rigid motion brings there."""


class Traverse(NamedTuple):
    """A session of n keyframes over a ground, or a piece of a solved map.

    Attributes:
        views: compared with the ground. motions: [n] into each keyframe, the first one's not used.
        least: log-odds of the way to either end below which a placement is dropped.
        solved: [n, 3] poses in the piece, m, m, rad; None: of a session, whose shape odometry alone knows.
    """

    views: Comparison
    motions: list[Motion]
    least: float = MIN_LOG_ODDS
    solved: np.ndarray | None = None

    def follow(self, ground: Ground, odds: GainOdds, k: int, pose: np.ndarray) -> Path:
        """The path with keyframe k at `pose` [3], to both ends of the session while it is likely enough; of a
        solved piece, if many places agree on one motion, that of the whole piece as a rigid body."""
        at = PoseHypothesis(pose, np.diag(ground.variance))
        views, motions = self.views, self.motions
        back = ((motions[i + 1].reversed(), views.gains(i)) for i in range(k - 1, -1, -1))
        before = follow(ground, odds, at, back, self.least)
        onwards = ((motions[i], views.gains(i)) for i in range(k + 1, len(motions)))
        after = follow(ground, odds, at, onwards, self.least)
        parts = zip(before[:2], after[:2], strict=True)
        poses, gained = (np.concatenate([one[:0:-1], other]) for one, other in parts)
        path = Path(poses, gained, k + 1 - len(before.poses))
        if self.solved is not None:
            confirmed = np.flatnonzero(path.odds > 0)
            own, found = self.solved[path.first + confirmed], path.poses[confirmed]
            together = _largest_rigid_part(ground, own, found)
            if together.sum() >= TOGETHER:
                moved = fit_rigid_motion(own[together], found[together])
                return self._along(ground, odds, compose(moved, self.solved))
        return path

    def _along(self, ground: Ground, odds: GainOdds, rigid: np.ndarray) -> Path:
        """The path of the piece at poses [n, 3] as a rigid body, corrected by the views."""
        loose = np.diag(ground.variance)
        at, inside, unconfirmed = PoseHypothesis(rigid[0], loose), False, UNCONFIRMED
        poses, gained = np.empty_like(rigid), np.zeros(len(rigid))
        for k, motion in enumerate(self.motions):
            if unconfirmed >= UNCONFIRMED:
                at, motion = PoseHypothesis(rigid[k], loose), NO_MOTION
            at, gain = advance(ground, at, motion, self.views.gains(k))
            gained[k], inside = keyframe_odds(ground, odds, at.pose, gain, inside)
            poses[k] = at.pose
            unconfirmed = 0 if gained[k] > 0 else unconfirmed + 1
        return Path(poses, gained)


def _largest_rigid_part(ground: Ground, own: np.ndarray, found: np.ndarray) -> np.ndarray:
    """[n] bool: the most poses `own` [n, 3] that one rigid motion brings to within the ground's reaches of
    those `found` [n, 3]."""
    best = np.zeros(len(own), bool)
    for k in range(len(own)):
        apart = between(compose(compose(found[k], inverse(own[k])), own), found)
        near = np.hypot(*apart[:, :2].T) < ground.reach
        together = near & (np.abs(wrap(apart[:, 2])) < ground.reach_heading)
        if together.sum() > best.sum():
            best = together
    return best


def find_placements(ground: Ground, odds: GainOdds, session: Traverse) -> list[Path]:
    """The different placements of a session that recall proposes and that remain likely to both its ends.

    A pose is proposed at a keyframe when `CONFIRMING` recalled poses in a row agree with the odometry between
    them, unless a path followed before passes it.

    Args:
        ground: keyframes of the map, with their poses.
        odds: log-odds of gains on this ground.
        session: its views compared with the ground, and its odometry.

    Returns:
        paths over all keyframes of the session, those with the largest log-odds first; of two that are
        together at most keyframes, the first one found.
    """
    tried: list[Path] = []
    found: list[Path] = []
    views, newest = session.views, NOTHING_RECALLED
    for k, moved in enumerate(session.motions):
        claim = int(views.shift[k]), int(views.match[k])
        newest = newest.onwards(ground, moved, *claim, float(views.posterior[k]))
        pose = newest.pose
        if not newest.is_confirmed or any(path.passes(ground, k, pose) for path in tried):
            continue
        path = session.follow(ground, odds, k, pose)
        tried.append(path)
        if len(path.poses) < len(session.motions):
            continue
        for other in found:
            pairs = enumerate(other.poses)
            if np.mean([same_pose(ground, path.poses[i : i + 1], there)[0] for i, there in pairs]) > 0.5:
                break
        else:
            found.append(path)
    return sorted(found, key=lambda path: -path.odds.sum())


def closures_along(ground: Ground, views: Comparison, path: Path) -> list[tuple[int, Match]]:
    """Keyframes of a session, by number, and where on the ground each fits best at its pose of a path, if it
    fits anything there better than a new place.

    Args:
        views: of the session's n keyframes. path: of the same.
    """
    found = []
    for k, pose in enumerate(path.poses):
        gain = views.gains(k)
        match = ground.best_match(pose, gain) if gain is not None else None
        if match is not None:
            found.append((k, match))
    return found
