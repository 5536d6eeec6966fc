"""Merging of keyframes, so that a map grows with the ground and not with time.

Keyframes of ground that closures have confirmed in several selections are merged with an older keyframe at
the same pose: they keep their pose relative to it, and their odometry joins the keyframes that remain.
Source: the reduced pose graph of Johannsson et al. 2013; which keyframes are merged is ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import CONFIRMED_WEIGHT, ClosureLog
from tactile.base.se2 import between, wrap

REACH = 10.0
"""Largest way to confirmed keyframes both before and after a merged one, cells."""
NEAR, FACING = 0.5, float(np.deg2rad(15.0))
"""Largest distance, cells, and largest difference in heading, rad, of keyframes that are merged."""
TENSE, AROUND = 9.0, 5
"""Chi-square of odometry above which keyframes within `AROUND` of it are not merged."""


class Merge(NamedTuple):
    """Keyframes to merge, of N.

    Attributes:
        kept: [n] keyframes that remain, ascending. onto: [N] the one of these, 0..n - 1, that each is or is
            merged with. offset: [N, 3] its pose in the frame of that one, m, m, rad; zero for `kept`.
    """

    kept: np.ndarray
    onto: np.ndarray
    offset: np.ndarray

    def is_kept(self) -> np.ndarray:
        """[N] bool."""
        kept = np.zeros(len(self.onto), bool)
        kept[self.kept] = True
        return kept

    def turned(self) -> np.ndarray:
        """[N] bool: keyframes that face opposite to the one they are merged with."""
        return np.cos(self.offset[:, 2]) < 0


def no_merge(count: int) -> Merge:
    """All of `count` keyframes remain."""
    return Merge(np.arange(count), np.arange(count), np.zeros((count, 3)))


def find_merge(graph: KeyframeGraph, log: ClosureLog, newest: int) -> Merge | None:
    """The keyframes of confirmed ground and the older ones at the same pose in the same piece, the `newest`
    left out; None without any."""
    count, guard = graph.count, graph.guard
    sure = np.flatnonzero(_confirmed_ground(graph, log))
    sure = sure[(sure > guard) & (sure < count - newest)]
    kept, onto, offset = np.ones(count, bool), np.arange(count), np.zeros((count, 3))
    pose, piece = graph.pose.rows, graph.pieces(log)
    whiskers = np.cos(graph.sector_angle) < 0  # views turned by half a turn are compared too
    for frame in sure.tolist():
        older = pose[: frame - guard]
        apart = ((older[:, :2] - pose[frame, :2]) ** 2).sum(axis=1) / (NEAR * graph.cell) ** 2
        turned = np.abs(wrap(older[:, 2] - pose[frame, 2]))
        turned = (np.minimum(turned, np.pi - turned) if whiskers else turned) / FACING
        joined = kept[: frame - guard] & (piece[: frame - guard] == piece[frame])
        far = np.where(joined & (turned <= 1), apart, np.inf)
        found = np.flatnonzero(far <= 1)
        if len(found):
            best = int(found[np.argmin(far[found] + turned[found] ** 2)])
            kept[frame], onto[frame] = False, best
            offset[frame] = between(pose[best], pose[frame])
    if kept.all():
        return None
    number = np.cumsum(kept) - 1
    return Merge(np.flatnonzero(kept), number[onto], offset)


def _confirmed_ground(graph: KeyframeGraph, log: ClosureLog) -> np.ndarray:
    """[N] bool: keyframes between confirmed ones, whose odometry is not strained."""
    held = _confirmed_keyframes(graph, log)
    reach = REACH * graph.cell
    # No way leads from one piece to the next.
    where, way = np.flatnonzero(held), np.cumsum(np.where(graph.begins.rows, 2 * reach, graph.length.rows))
    if not len(where):
        return held
    before = np.searchsorted(where, np.arange(len(held)), side="right") - 1
    after = np.searchsorted(where, np.arange(len(held)))
    between_two = (before >= 0) & (after < len(where))
    since = way - way[where[np.maximum(before, 0)]]
    until = way[where[np.minimum(after, len(where) - 1)]] - way
    sure = between_two & (since <= reach) & (until <= reach)
    broken = graph.is_broken(graph.cut)
    sure &= ~broken
    sure[:-1] &= ~broken[1:]
    tense = _strained(graph)
    sure[1:] &= ~tense
    sure[:-1] &= ~tense
    return sure


def _confirmed_keyframes(graph: KeyframeGraph, log: ClosureLog) -> np.ndarray:
    """[N] bool: keyframes of sequences that stood several selections, and both ends of seams."""
    held = graph.seam.rows.copy()
    held[:-1] |= graph.seam.rows[1:]
    rows = log.table()[log.accepted_rows()]
    stood = log.stood()[rows[:, 5].astype(int)] >= graph.config.merge_stood
    held[rows[stood & (rows[:, 8] > CONFIRMED_WEIGHT), 0].astype(int)] = True
    return held


def _strained(graph: KeyframeGraph) -> np.ndarray:
    """[N - 1] bool: the odometry from one keyframe to the next, or near by, is strained."""
    fit, chain = graph.fit(), graph.odometry(graph.cut)
    error = between(fit.poses[:-1], fit.poses[1:]) - fit.corrected(chain)
    error[:, 2] = wrap(error[:, 2])
    tense = (error**2 / chain.variance).sum(axis=1) > TENSE  # never at seams, which are loose
    return np.convolve(tense, np.ones(2 * AROUND + 1), "same") > 0.5
