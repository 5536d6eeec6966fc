"""Merging of keyframes, so that a map grows with the ground and not with time.

Keyframes of ground that closures have confirmed in several selections are merged with an older keyframe at
the same pose: they keep their pose relative to it, and their odometry becomes links between the keyframes
that remain. Source: the reduced pose graph of Johannsson et al. 2013.
"""

from __future__ import annotations

import numpy as np

from ratslam.mapping.loop_closures import CONFIRMED_WEIGHT
from ratslam.mapping.map_state import MapState
from ratslam.mapping.optimizer import OdometryLinks
from ratslam.recall.memory import MergedRows
from tactile.base.se2 import between, compose, inverse, wrap

REACH = 10.0
"""Largest way to confirmed keyframes both before and after a merged one, cells."""
NEAR, FACING = 0.5, float(np.deg2rad(15.0))
"""Largest distance, cells, and largest difference in heading, rad, of keyframes that are merged."""
TENSE, AROUND = 9.0, 5
"""Chi-square of odometry above which keyframes within `AROUND` of it are not merged."""


def find_merge(state: MapState, newest: int) -> MergedRows | None:
    """The keyframes of confirmed ground and the older ones at the same pose in the same piece, the `newest`
    left out; None without any."""
    count, guard = state.count, state.guard
    sure = np.flatnonzero(_confirmed_ground(state))
    sure = sure[(sure > guard) & (sure < count - newest)]
    kept, onto, offset = np.ones(count, bool), np.arange(count), np.zeros((count, 3))
    pose, piece, half_turns = state.pose.rows, state.pieces(), state.half_turns
    for frame in sure.tolist():
        older = pose[: frame - guard]
        apart = ((older[:, :2] - pose[frame, :2]) ** 2).sum(axis=1) / (NEAR * state.cell) ** 2
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
    return MergedRows(np.flatnonzero(kept), number[onto], offset)


def _confirmed_ground(state: MapState) -> np.ndarray:
    """[N] bool: keyframes between confirmed ones, whose odometry is not strained."""
    # Confirmed are keyframes of sequences kept by several selections, and both ends of seams.
    held = state.seam.rows.copy()
    held[:-1] |= state.seam.rows[1:]
    log = state.log
    rows = log.table()[log.accepted_rows()]
    kept = log.confirmations()[rows[:, 5].astype(int)] >= state.config.merge_stood
    held[rows[kept & (rows[:, 8] > CONFIRMED_WEIGHT), 0].astype(int)] = True
    reach = REACH * state.cell
    # No way leads from one piece to the next.
    where, way = np.flatnonzero(held), np.cumsum(np.where(state.begins.rows, 2 * reach, state.length.rows))
    if not len(where):
        return held
    before = np.searchsorted(where, np.arange(len(held)), side="right") - 1
    after = np.searchsorted(where, np.arange(len(held)))
    between_two = (before >= 0) & (after < len(where))
    since = way - way[where[np.maximum(before, 0)]]
    until = way[where[np.minimum(after, len(where) - 1)]] - way
    sure = between_two & (since <= reach) & (until <= reach)
    broken = state.is_broken()
    sure &= ~broken
    sure[:-1] &= ~broken[1:]
    # Odometry from one keyframe to the next that is strained, or near such; never at seams, which are loose.
    tense = state.fit().strain(state.odometry()) > TENSE
    tense = np.convolve(tense, np.ones(2 * AROUND + 1), "same") > 0.5
    sure[1:] &= ~tense
    sure[:-1] &= ~tense
    return sure


ATTACHED = 0.1
"""Standard deviation of position of a merged keyframe relative to the one it is merged with, cells."""


def merge_keyframes(state: MapState, merge: MergedRows) -> None:
    """Removes the merged keyframes from the map: their odometry joins the keyframes that remain, and
    odometry over a row of merged ones is composed (a seam), where it no longer counts.

    The links are those so far and the odometry from and to merged keyframes, parallel ones fused by their
    information. Variances of headings are those without learned noise.
    """
    old, kept = state.links, merge.is_kept()
    broken = state.seam.rows | state.is_broken()
    later = np.flatnonzero((~kept[1:] | ~kept[:-1]) & ~broken[1:]) + 1
    attached = (ATTACHED * state.cell) ** 2 * np.array([1.0, 1.0, 0.0])
    variance = np.concatenate([state.own_variances()[later] + attached, old.variance])
    motion = np.concatenate([state.motion.rows[later], old.motion])
    length = np.concatenate([state.length.rows[later], old.length])
    turn = np.concatenate([state.motion.rows[later, 2], old.turn])
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
    skipped = take_keyframes(state, merge.source)
    state.seam.rows[skipped] = True
    state.links = links


def take_keyframes(state: MapState, rows: np.ndarray) -> np.ndarray:
    """Reduces the map to the keyframes `rows` [n], ascending, with odometry composed over those that are
    left out; links are not touched.

    Returns:
        those of the n keyframes before which some were left out.
    """
    motion, length, turn = state.motion.rows.copy(), state.length.rows.copy(), state.turn.rows.copy()
    after = np.flatnonzero(np.diff(rows) > 1)
    earlier, later = rows[after], rows[after + 1]
    reckoned = state.dead_reckoned()
    motion[later] = between(reckoned[earlier], reckoned[later])
    for values in (length, turn):
        sums = np.cumsum(values)
        values[later] = sums[later] - sums[earlier]
    state.motion.replace(motion)
    state.length.replace(length)
    state.turn.replace(turn)
    state.take(rows)
    return after + 1


def _summed(group: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """[count, 3] sums of values [n, 3] by group [n]."""
    return np.stack([np.bincount(group, values[:, c], count) for c in range(3)], axis=1)
