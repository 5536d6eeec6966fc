"""Revisits that the poses of a map claim, and whether the views bear them out.

A keyframe near older ones that face alike claims a revisit: one of each pass of the robot there, so that a
pass that is right does not hide one that is wrong. Where a claim is right, the view is more like those near
it than like views elsewhere; where it is wrong, it is so by chance. The comparison is by ranks: no constant
is in units of the sensor, and views that are alike everywhere count little. The rules are ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.mapping.appearance import near_facing
from ratslam.mapping.keyframe_graph import KeyframeGraph

RADIUS = 2.0
"""Distance within which keyframes are near each other, cells."""
FACING = float(np.cos(0.5))
"""Cosine of the largest difference in heading of two keyframes that face alike."""
CONTROLS = np.arange(1, 9) / 9
"""Shares of the older keyframes by which those near a keyframe are moved on in memory, as controls."""
JUDGED = 150
"""Largest number of keyframes by whose claims a map is compared with others."""
SHAPE, DOUBTFUL = 4.0, 0.05
"""The likeness of right claims has the density `SHAPE` u^(`SHAPE` - 1), and a share of uniform ones."""
ALONE = 5.0
"""Number of successive keyframes whose views count as one, because they are alike."""


class ClaimedRevisits(NamedTuple):
    """n claims by `examined` keyframes.

    Attributes:
        frame: [n] keyframe. match: [n] the first of the older keyframes near it, of one pass. likeness: [n]
            share of the controls that its view fits worse than these, 0..1; ties count half; 0.5 by chance. A
            control is as many keyframes elsewhere among the older ones, in the same order.
    """

    frame: np.ndarray
    match: np.ndarray
    likeness: np.ndarray
    examined: int


def claimed_revisits(graph: KeyframeGraph, poses: np.ndarray, most: int) -> ClaimedRevisits:
    """The claims of poses [N, 3] of the keyframes; at most `most` keyframes are examined, spread evenly."""
    first, count = graph.guard + 1, len(poses)
    frames = np.unique(np.linspace(first, count - 1, max(min(count - first, most), 0)).astype(int))
    facing = near_facing(poses, frames, graph.guard, RADIUS * graph.cell, FACING)
    whiskers = np.cos(graph.sector_angle) < 0  # views turned by half a turn are compared too
    row, near = np.nonzero(facing if whiskers else facing > 0)
    frame, reversed = frames[row], facing[row, near] < 0
    if not len(frame):
        return ClaimedRevisits(frame, near, np.zeros(0), len(frames))
    shares = np.concatenate([[0.0], CONTROLS])
    older = (frame - graph.guard)[:, None]
    others = (near[:, None] + (older * shares).astype(int)) % older
    repeated = len(shares)
    unlike = graph.unlikeness(np.repeat(frame, repeated), others.ravel(), np.repeat(reversed, repeated))
    passes = np.flatnonzero(np.diff(near, prepend=-1 - graph.guard) > graph.guard)
    passes = np.union1d(passes, np.flatnonzero(np.diff(frame, prepend=-1)))
    best = np.minimum.reduceat(unlike.reshape(others.shape), passes, axis=0)
    here, elsewhere = best[:, :1], best[:, 1:]
    likeness = (here < elsewhere).mean(axis=1) + (here == elsewhere).mean(axis=1) / 2
    return ClaimedRevisits(frame[passes], near[passes], likeness, len(frames))


def claims_cost(graph: KeyframeGraph, poses: np.ndarray) -> float:
    """What the views say against poses [N, 3] of the keyframes, chi-square: -2 times the log ratio of the
    density of the likenesses where claims are right to that where they are wrong (uniform), for as many
    independent views as there are times `ALONE` keyframes."""
    claims = claimed_revisits(graph, poses, JUDGED)
    if not len(claims.frame):
        return 0.0
    right = DOUBTFUL + (1 - DOUBTFUL) * SHAPE * claims.likeness ** (SHAPE - 1)
    _, frame = np.unique(claims.frame, return_inverse=True)
    each = np.bincount(frame, np.log(right)) / np.bincount(frame)
    return float(-2 * each.sum() * len(poses) / (claims.examined * ALONE))
