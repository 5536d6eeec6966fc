"""The odometry between keyframes after others were merged."""

from __future__ import annotations

import numpy as np

from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.merging import Merge
from ratslam.mapping.optimizer import OdometryLinks
from tactile.base.se2 import between, compose, inverse, wrap

ATTACHED = 0.1
"""Standard deviation of position of a merged keyframe relative to the one it is merged with, cells."""


def merge_keyframes(graph: KeyframeGraph, merge: Merge) -> None:
    """Removes the merged keyframes from the graph: their odometry joins the keyframes that remain, and
    odometry over a row of merged ones is composed (a seam), where it no longer counts."""
    links = _links(graph, merge)
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


def _links(graph: KeyframeGraph, merge: Merge) -> OdometryLinks:
    """Links between the remaining keyframes: those so far, and the odometry from and to merged ones; parallel
    ones as one. Variances of headings are those without learned noise."""
    old, kept = graph.links, merge.is_kept()
    broken = graph.seam.rows | graph.is_broken(graph.cut)
    later = np.flatnonzero((~kept[1:] | ~kept[:-1]) & ~broken[1:]) + 1
    attached = (ATTACHED * graph.cell) ** 2 * np.array([1.0, 1.0, 0.0])
    own = graph.own_variances()[later] + attached
    motion = np.concatenate([graph.motion.rows[later], old.motion])
    i, j = np.concatenate([later - 1, old.i]), np.concatenate([later, old.j])
    motion = compose(compose(merge.offset[i], motion), inverse(merge.offset[j]))
    i, j = merge.onto[i], merge.onto[j]
    return _fused(
        OdometryLinks(
            i,
            j,
            motion,
            np.concatenate([graph.length.rows[later], old.length]),
            np.concatenate([graph.motion.rows[later, 2], old.turn]),
            np.concatenate([own, old.variance]),
        )
    )


def _fused(links: OdometryLinks) -> OdometryLinks:
    """The links from the lower to the higher keyframe, parallel ones as one by their information."""
    swapped = links.i > links.j
    motion = np.where(swapped[:, None], inverse(links.motion), links.motion)
    turn, length = np.where(swapped, -links.turn, links.turn), np.where(swapped, -links.length, links.length)
    i, j = np.minimum(links.i, links.j), np.maximum(links.i, links.j)
    apart = i != j
    size = int(j.max(initial=0)) + 1
    pairs, first, group = np.unique(i[apart] * size + j[apart], return_index=True, return_inverse=True)
    information = 1 / links.variance[apart]
    total = _summed(group, information, len(pairs))
    reference = motion[apart][first]
    off = motion[apart] - reference[group]
    off[:, 2] = wrap(off[:, 2])
    mean = reference + _summed(group, information * off, len(pairs)) / total
    mean[:, 2] = wrap(mean[:, 2])
    by_heading = information[:, 2] / total[group, 2]
    return OdometryLinks(
        pairs // size,
        pairs % size,
        mean,
        np.bincount(group, by_heading * length[apart], len(pairs)),
        np.bincount(group, by_heading * turn[apart], len(pairs)),
        1 / total,
    )


def _summed(group: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """[count, 3] sums of values [n, 3] by group [n]."""
    return np.stack([np.bincount(group, values[:, c], count) for c in range(3)], axis=1)
