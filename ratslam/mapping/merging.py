"""Merging of keyframes, so that a map grows with the ground and not with time.

Keyframes of ground that closures have confirmed in several selections are merged with an older keyframe at
the same pose: they keep their pose relative to it, and their odometry becomes links between the keyframes
that remain. Source: the reduced pose graph of Johannsson et al. 2013.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import CONFIRMED_WEIGHT, ClosureLog
from ratslam.mapping.optimizer import OdometryLinks
from tactile.base.se2 import between, compose, inverse, wrap

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

    @classmethod
    def of_none(cls, count: int) -> Merge:
        """All of `count` keyframes remain."""
        return cls(np.arange(count), np.arange(count), np.zeros((count, 3)))

    def is_kept(self) -> np.ndarray:
        """[N] bool."""
        kept = np.zeros(len(self.onto), bool)
        kept[self.kept] = True
        return kept

    def turned(self) -> np.ndarray:
        """[N] bool: keyframes that face opposite to the one they are merged with."""
        return np.cos(self.offset[:, 2]) < 0


def find_merge(graph: KeyframeGraph, log: ClosureLog, newest: int) -> Merge | None:
    """The keyframes of confirmed ground and the older ones at the same pose in the same piece, the `newest`
    left out; None without any."""
    count, guard = graph.count, graph.guard
    sure = np.flatnonzero(_confirmed_ground(graph, log))
    sure = sure[(sure > guard) & (sure < count - newest)]
    kept, onto, offset = np.ones(count, bool), np.arange(count), np.zeros((count, 3))
    pose, piece, half_turns = graph.pose.rows, graph.pieces(log), graph.half_turns
    for frame in sure.tolist():
        older = pose[: frame - guard]
        apart = ((older[:, :2] - pose[frame, :2]) ** 2).sum(axis=1) / (NEAR * graph.cell) ** 2
        turned = np.abs(wrap(older[:, 2] - pose[frame, 2]))
        turned = (np.minimum(turned, np.pi - turned) if half_turns else turned) / FACING
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
    # Confirmed are keyframes of sequences kept by several selections, and both ends of seams.
    held = graph.seam.rows.copy()
    held[:-1] |= graph.seam.rows[1:]
    rows = log.table()[log.accepted_rows()]
    kept = log.confirmations()[rows[:, 5].astype(int)] >= graph.config.merge_stood
    held[rows[kept & (rows[:, 8] > CONFIRMED_WEIGHT), 0].astype(int)] = True
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
    # Odometry from one keyframe to the next that is strained, or near such; never at seams, which are loose.
    tense = graph.fit().strain(graph.odometry(graph.cut)) > TENSE
    tense = np.convolve(tense, np.ones(2 * AROUND + 1), "same") > 0.5
    sure[1:] &= ~tense
    sure[:-1] &= ~tense
    return sure


ATTACHED = 0.1
"""Standard deviation of position of a merged keyframe relative to the one it is merged with, cells."""


def merge_keyframes(graph: KeyframeGraph, merge: Merge) -> None:
    """Removes the merged keyframes from the graph: their odometry joins the keyframes that remain, and
    odometry over a row of merged ones is composed (a seam), where it no longer counts.

    The links are those so far and the odometry from and to merged keyframes, parallel ones fused by their
    information. Variances of headings are those without learned noise.
    """
    old, kept = graph.links, merge.is_kept()
    broken = graph.seam.rows | graph.is_broken(graph.cut)
    later = np.flatnonzero((~kept[1:] | ~kept[:-1]) & ~broken[1:]) + 1
    attached = (ATTACHED * graph.cell) ** 2 * np.array([1.0, 1.0, 0.0])
    variance = np.concatenate([graph.own_variances()[later] + attached, old.variance])
    motion = np.concatenate([graph.motion.rows[later], old.motion])
    length = np.concatenate([graph.length.rows[later], old.length])
    turn = np.concatenate([graph.motion.rows[later, 2], old.turn])
    i, j = np.concatenate([later - 1, old.i]), np.concatenate([later, old.j])
    motion = compose(compose(merge.offset[i], motion), inverse(merge.offset[j]))
    i, j = merge.onto[i], merge.onto[j]
    # From the lower to the higher keyframe; keyframes merged into one have no link.
    swapped = i > j
    motions = np.where(swapped[:, None], inverse(motion), motion)
    turn, length = np.where(swapped, -turn, turn), np.where(swapped, -length, length)
    i, j = np.minimum(i, j), np.maximum(i, j)
    apart = i != j
    size = int(j.max(initial=0)) + 1
    pairs, first, group = np.unique(i[apart] * size + j[apart], return_index=True, return_inverse=True)
    # Means weighted by information, of the deviations from the first of the parallel links.
    information = 1 / variance[apart]
    total = _summed(group, information, len(pairs))
    reference = motions[apart][first]
    off = motions[apart] - reference[group]
    off[:, 2] = wrap(off[:, 2])
    mean = reference + _summed(group, information * off, len(pairs)) / total
    mean[:, 2] = wrap(mean[:, 2])
    by_heading = information[:, 2] / total[group, 2]
    length, turn = (np.bincount(group, by_heading * each[apart], len(pairs)) for each in (length, turn))
    links = OdometryLinks(pairs // size, pairs % size, mean, length, turn, 1 / total)
    skipped = take_keyframes(graph, merge.kept)
    graph.seam.rows[skipped] = True
    graph.links = links


def take_keyframes(graph: KeyframeGraph, rows: np.ndarray) -> np.ndarray:
    """Reduces the graph to the keyframes `rows` [n], ascending, with odometry composed over those that are
    left out; links are not touched.

    Returns:
        those of the n keyframes before which some were left out.
    """
    motion, length, turn = graph.motion.rows.copy(), graph.length.rows.copy(), graph.turn.rows.copy()
    after = np.flatnonzero(np.diff(rows) > 1)
    earlier, later = rows[after], rows[after + 1]
    reckoned = graph.dead_reckoned()
    motion[later] = between(reckoned[earlier], reckoned[later])
    for values in (length, turn):
        sums = np.cumsum(values)
        values[later] = sums[later] - sums[earlier]
    graph.motion.replace(motion)
    graph.length.replace(length)
    graph.turn.replace(turn)
    graph.take(rows)
    return after + 1


def _summed(group: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """[count, 3] sums of values [n, 3] by group [n]."""
    return np.stack([np.bincount(group, values[:, c], count) for c in range(3)], axis=1)
