"""A map compared with itself: gains at revisits, and at other places that look alike.

The later keyframes of the map play a session on the ground of the earlier ones. Each of some stretches is
followed from its own pose, and from the poses elsewhere whose first views fit best."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ratslam.mapping.following import STILL, Motion, Supposed, advance_all
from ratslam.mapping.gain_odds import PLAIN, GainOdds, Weighing, learn_gain_odds
from ratslam.mapping.ground import Ground
from tactile.base.se2 import between, wrap

STRETCHES = 24
"""Number of stretches."""
LENGTH, FIRST = 48, 8
"""Keyframes of a stretch, and of its beginning, by which alike places are chosen and known as such."""
ALIKE = 6
"""Number of other places from which each stretch is followed."""
ELSEWHERE = 2.0
"""Least distance of another place, as a multiple of the ground's reach."""

Gains = Callable[[int, int], np.ndarray]
"""Gains [n, S, M] of the n keyframes that follow a keyframe, against those of the ground before it.
Arguments: the keyframe, n."""


class Stretch(NamedTuple):
    """Consecutive keyframes: ground before them, their gains [n, S, M] on it, the motions between them, and
    the pose [3] of the first."""

    ground: Ground
    gains: np.ndarray
    motions: list[Motion]
    start: np.ndarray

    def follow(self, poses: np.ndarray, count: int) -> np.ndarray:
        """[P, count] gains of the first keyframes, supposed to begin at each of `poses` [P, 3]."""
        at, found = Supposed(poses, np.zeros((len(poses), 3, 3))), np.zeros((len(poses), count))
        for k in range(count):
            at, found[:, k] = advance_all(self.ground, at, self.motions[k], self.gains[k])
        return found


def compare_with_itself(
    ground: Ground, guard: int, gains: Gains, held: np.ndarray | None = None, weighing: Weighing = PLAIN
) -> GainOdds:
    """The log-odds of gains on this ground.

    Args:
        guard: number of keyframes before a stretch that do not count as ground. held: [N] bool, the keyframes
            that are ground for a session; None: all. weighing: of the gains.
    """
    count = len(ground.poses)
    held = np.ones(count, bool) if held is None else held
    first = max(count // 3, 2 * guard)
    true, false = [np.zeros(0)], [np.zeros(0)]
    if count > first + LENGTH + guard:
        for begin in np.linspace(first, count - LENGTH - 1, STRETCHES).astype(int).tolist():
            stretch = _stretch(ground, begin, guard, gains, held)
            stretch = stretch._replace(gains=weighing.weigh(stretch.gains))
            here, *elsewhere = stretch.follow(np.stack([stretch.start, *_alike(stretch)]), LENGTH)
            true.append(_continued(here, weighing.matching))
            false += [_continued(gain, weighing.matching) for gain in elsewhere]
    return learn_gain_odds(np.concatenate(true), np.concatenate(false), weighing.prior)


def _stretch(ground: Ground, begin: int, guard: int, gains: Gains, held: np.ndarray) -> Stretch:
    poses = ground.poses[begin : begin + LENGTH]
    motions = [STILL, *(Motion(step, np.zeros(3)) for step in between(poses[:-1], poses[1:]))]
    known = begin - guard
    earlier = ground._replace(poses=ground.poses[:known][held[:known]])
    found = gains(begin, LENGTH)[:, :, : len(earlier.poses)]
    return Stretch(earlier, found, motions, poses[0])


def _alike(stretch: Stretch) -> np.ndarray:
    """Poses [n, 3] elsewhere on the ground at which the beginning of the stretch fits best."""
    ground = stretch.ground
    shift, frame = (index.reshape(-1) for index in np.indices((len(ground.turns), len(ground.poses))))
    claims = ground.claims(shift, frame)
    apart = np.hypot(*(claims - stretch.start)[:, :2].T)
    same = (apart < ELSEWHERE * ground.reach) & _facing(claims, stretch.start, ground)
    claims = _spread_out(claims[~same], ground)
    gains = stretch.follow(claims, FIRST)
    fits = np.where(np.isfinite(gains), gains, -1.0).sum(axis=1)
    return claims[np.argsort(fits, kind="stable")[::-1][:ALIKE]]


def _spread_out(poses: np.ndarray, ground: Ground) -> np.ndarray:
    """The poses [n, 3] without those near an earlier one that faces alike."""
    kept: list[int] = []
    for k, pose in enumerate(poses):
        near = np.hypot(*(poses[kept] - pose)[:, :2].T) < ground.reach
        if not (near & _facing(poses[kept], pose, ground)).any():
            kept.append(k)
    return poses[kept]


def _facing(poses: np.ndarray, pose: np.ndarray, ground: Ground) -> np.ndarray:
    return np.abs(wrap(poses[:, 2] - pose[2])) < 2 * ground.reach_heading


def _continued(gain: np.ndarray, matching: float) -> np.ndarray:
    """The gains of a stretch that follow `FIRST` matching ones."""
    rows = np.lib.stride_tricks.sliding_window_view(gain, FIRST)[:-1]
    before = np.isfinite(rows).all(axis=1) & (np.nan_to_num(rows).mean(axis=1) > matching)
    found = gain[FIRST:][before]
    return found[np.isfinite(found)]
