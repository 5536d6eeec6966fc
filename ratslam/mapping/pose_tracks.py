"""Tracks: a pose hypothesis followed from keyframe to keyframe, and how well the views fit on the way.

The keyframes of a map are the ground, and the same keyframes in order of time are the session that is placed
on it; none is compared with keyframes of nearly the same time. The rule is that of `ratslam.mapping.ground`
with variances of position and heading alone, in compiled loops, because hundreds of tracks are followed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.core.compiled import compiled
from ratslam.mapping.ground import LEAVING, REACH, REACH_HEADING, GainOdds, Ground, grown_reaches
from ratslam.mapping.map_state import MapState
from ratslam.mapping.optimizer import MapFit
from tactile.base.se2 import inverse

LOST, WINDOW = -25.0, 15
"""Log-odds of the last `WINDOW` keyframes below which a track ends."""
CLIPPED = 20.0
"""Largest absolute log-odds of one view when many poses are compared at once, nat."""


Track = tuple[np.ndarray, np.ndarray]
"""Poses [N, 3], and log-odds [N] of each keyframe: NaN and -inf where the track does not lead."""


class SelfTraverse(NamedTuple):
    """A session of N keyframes over its own map: they are ground and session.

    Attributes:
        ground: at their poses. fits: [N, S, N], see `view_fits`. motions, variances: [N - 1, 3] of the
            odometry, without its systematic errors and without breaks.
    """

    ground: Ground
    fits: np.ndarray
    motions: np.ndarray
    variances: np.ndarray

    @classmethod
    def of_map(cls, state: MapState, fit: MapFit, fits: np.ndarray) -> SelfTraverse:
        """The keyframes of a map at the poses of a fit."""
        motions = fit.corrected(state.odometry())
        variances = state.odometry_variance(state.length.rows, state.turn.rows)[1:]
        turns, reach = np.arange(fits.shape[1]) * np.pi, REACH * state.cell
        ground = Ground(fit.poses, turns, reach, REACH_HEADING, state.closure_variance())
        return cls(ground, fits, motions, variances)

    @property
    def poses(self) -> np.ndarray:
        """[N, 3] m, m, rad."""
        return self.ground.poses

    @property
    def size(self) -> int:
        """N."""
        return len(self.poses)

    def own_fits(self) -> np.ndarray:
        """[N] how well each view fits at the keyframe's own pose, NaN where no keyframe is near."""
        return np.array([self._fit(frame, pose) for frame, pose in enumerate(self.poses)])

    def _fit(self, frame: int, pose: np.ndarray) -> float:
        """How well the view of a keyframe fits at a pose [3], NaN where no keyframe is near."""
        on = self.ground
        return _look(on.poses, on.turns, self.fits[frame], pose, on.reach, on.reach_heading)[0]

    def own_odds(self, odds: GainOdds) -> np.ndarray:
        """[N] the log-odds of each view at the keyframe's own pose."""
        fits = self.own_fits()
        off = np.isnan(fits)
        left = off & ~np.concatenate([[True], off[:-1]])
        seen = odds.odds[np.searchsorted(odds.edges, np.where(off, 0.0, fits))]
        return np.where(off, np.where(left, LEAVING, 0.0), seen)

    def follow(self, frame: int, pose: np.ndarray, stop: int, odds: GainOdds) -> tuple[np.ndarray, ...]:
        """Follows a pose [3] of a keyframe until keyframe `stop`, or until it is lost.

        Returns:
            keyframes [n], poses [n, 3], fits [n] and log-odds [n] of those that come after `frame`.
        """
        stop = min(max(stop, 0), self.size - 1)
        ahead = stop >= frame
        frames = np.arange(frame + 1, stop + 1) if ahead else np.arange(frame - 1, stop - 1, -1)
        motions = self.motions[frames - 1] if ahead else inverse(self.motions[frames])
        variances = self.variances[frames - 1] if ahead else self.variances[frames]
        on, session = self.ground, (frames, motions, variances)
        reach = on.variance, on.reach, on.reach_heading
        found = _follow(on.poses, on.turns, self.fits, *session, *reach, odds.edges, odds.odds, pose)
        return frames[: len(found[0])], *found

    def track(self, first: int, poses: np.ndarray, gained: np.ndarray, extent: int, odds: GainOdds) -> Track:
        """The track through the keyframes from number `first` on at `poses` [n, 3], where they have these
        log-odds [n], and at most `extent` keyframes after and before them."""
        every, of_each = track = np.full((self.size, 3), np.nan), np.full(self.size, -np.inf)
        last = first + len(poses) - 1
        every[first : last + 1], of_each[first : last + 1] = poses, gained
        for end, stop in ((last, last + extent), (first, first - extent)):
            frames, onwards, _, more = self.follow(end, every[end].copy(), stop, odds)
            every[frames], of_each[frames] = onwards, more
        return track

    def track_from(self, frame: int, pose: np.ndarray, extent: int, odds: GainOdds) -> Track:
        """The track through a keyframe at a pose [3]."""
        fit = self._fit(frame, pose)
        gained = LEAVING if np.isnan(fit) else odds.of(fit)
        return self.track(frame, pose[None], np.array([gained]), extent, odds)

    def places(self) -> np.ndarray:
        """[C, 3] poses that a robot may have on the ground, one of each that can be told apart."""
        on = self.ground
        return _spread_out(on.poses, on.turns, on.reach, on.reach_heading)

    def scan(self, frame: int, places: np.ndarray, length: int) -> np.ndarray:
        """[C] how well the views of a keyframe and those after it, `length` together, fit if the keyframe
        is at each of the places [C, 3]."""
        on, last = self.ground, min(frame + length, self.size)
        reach = on.reach, on.reach_heading
        return _scan(on.poses, on.turns, self.fits, self.motions, places, frame, last, *reach)


@compiled
def _turned(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi


@compiled
def _look(
    poses: np.ndarray, turns: np.ndarray, fits: np.ndarray, pose: np.ndarray, reach: float, turn: float
) -> tuple[float, float, float, float]:
    """The best fit [S, N] of the keyframes near a pose, NaN without any, and the mean difference from it of
    the poses that they claim, weighted by the likelihood (m, m, rad)."""
    best, total, dx, dy, da = -np.inf, 0.0, 0.0, 0.0, 0.0
    for i in range(len(poses)):
        x, y = poses[i, 0] - pose[0], poses[i, 1] - pose[1]
        if x * x + y * y >= reach * reach:
            continue
        for s in range(len(turns)):
            angle = _turned(poses[i, 2] + turns[s] - pose[2])
            fit = fits[s, i]
            if abs(angle) >= turn or fit == -np.inf:
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
def _follow(
    ground: np.ndarray, turns: np.ndarray, fits: np.ndarray,
    frames: np.ndarray, motions: np.ndarray, variances: np.ndarray, spread: np.ndarray,
    reach: float, reach_heading: float, edges: np.ndarray, odds: np.ndarray, start: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """See `SelfTraverse.follow`."""
    count = len(frames)
    poses, found, gained = np.empty((count, 3)), np.empty(count), np.empty(count)
    pose, place, heading = start.copy(), spread[0], spread[2]  # with its variances
    inside, recent = True, 0.0
    for k in range(count):
        # Prediction by odometry, position variance alike in all directions.
        c, s = np.cos(pose[2]), np.sin(pose[2])
        x, y = motions[k, 0], motions[k, 1]
        pose[0], pose[1] = pose[0] + c * x - s * y, pose[1] + s * x + c * y
        pose[2] = _turned(pose[2] + motions[k, 2])
        place += variances[k, 0] + heading * (x * x + y * y)
        heading += variances[k, 2]
        near, turn = grown_reaches(reach, reach_heading, place, heading)
        fit, dx, dy, da = _look(ground, turns, fits[frames[k]], pose, near, turn)
        if fit > 0:  # Kalman update by the mean of the poses that the views claim
            share, turned = place / (place + spread[0]), heading / (heading + spread[2])
            pose[0], pose[1] = pose[0] + share * dx, pose[1] + share * dy
            pose[2] = _turned(pose[2] + turned * da)
            place, heading = place * (1 - share), heading * (1 - turned)
        if np.isnan(fit):
            gained[k] = LEAVING if inside else 0.0
        else:
            gained[k] = odds[np.searchsorted(edges, fit)]
        inside = not np.isnan(fit)
        poses[k], found[k] = pose, fit
        recent += gained[k] - (gained[k - WINDOW] if k >= WINDOW else 0.0)
        if recent < LOST:
            return poses[: k + 1], found[: k + 1], gained[: k + 1]
    return poses, found, gained


@compiled
def _scan(
    ground: np.ndarray, turns: np.ndarray, fits: np.ndarray, motions: np.ndarray, places: np.ndarray,
    first: int, last: int, reach: float, reach_heading: float,
) -> np.ndarray:  # fmt: skip
    """See `SelfTraverse.scan`."""
    total = np.zeros(len(places))
    for k in range(len(places)):
        pose = places[k].copy()
        for frame in range(first, last):
            fit = _look(ground, turns, fits[frame], pose, reach, reach_heading)[0]
            total[k] += -1.0 if np.isnan(fit) else min(max(fit, -CLIPPED), CLIPPED)
            if frame + 1 < last:
                c, s = np.cos(pose[2]), np.sin(pose[2])
                x, y = motions[frame, 0], motions[frame, 1]
                pose[0], pose[1] = pose[0] + c * x - s * y, pose[1] + s * x + c * y
                pose[2] = _turned(pose[2] + motions[frame, 2])
    return total


@compiled
def _spread_out(poses: np.ndarray, turns: np.ndarray, reach: float, reach_heading: float) -> np.ndarray:
    """See `SelfTraverse.places`."""
    kept = np.empty((len(turns) * len(poses), 3))
    count = 0
    for s in range(len(turns)):
        for i in range(len(poses)):
            angle = _turned(poses[i, 2] + turns[s])
            known = False
            for k in range(count):
                x, y = kept[k, 0] - poses[i, 0], kept[k, 1] - poses[i, 1]
                near = x * x + y * y < reach * reach / 2
                known = known or (near and abs(_turned(kept[k, 2] - angle)) < reach_heading)
            if not known:
                kept[count, 0], kept[count, 1], kept[count, 2] = poses[i, 0], poses[i, 1], angle
                count += 1
    return kept[:count].copy()
