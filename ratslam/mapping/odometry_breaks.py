"""Odometry breaks, where the robot was carried: located by the views, bridged by a closure sequence."""

from __future__ import annotations

import numpy as np

from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import ClosureLog, Verdict
from ratslam.mapping.verification import turn_on_spot
from tactile.base.se2 import compose, inverse

SEARCH = 400
"""Number of keyframes among which a break is searched."""


def break_odometry(graph: KeyframeGraph, log: ClosureLog, sequence: int) -> None:
    """Cuts the odometry where the views show the break, and joins the parts by the sequence."""
    members, pose = log.members(sequence), graph.pose.rows
    middle = members[len(members) // 2]
    found = turn_on_spot(pose[middle[1]], -middle[2] * graph.sector_angle)
    carried = compose(found, inverse(pose[middle[0]]))
    # The first keyframe whose views fit better at the poses moved by `carried` [3].
    first = int(members[0, 0])
    anchored = log.table()[log.accepted_rows(), 0]
    began = int(np.flatnonzero(graph.begins.rows[: first + 1]).max(initial=0))
    since = max(int(anchored[anchored < first].max(initial=0)) - graph.config.max_gap, began)
    frames = np.arange(max(since, first - SEARCH, 1), first + 1)
    at = _find_turning_point(graph, frames, graph.pose.rows, graph.pose.rows[frames], carried)
    graph.cut.rows[at] = sequence
    pose[at:] = compose(carried, pose[at:])
    log.strike(at, sequence)
    log.judge(sequence, Verdict.ACCEPTED)


def find_break(
    graph: KeyframeGraph, poses: np.ndarray, onwards: np.ndarray, carried: np.ndarray, since: int
) -> int:
    """The keyframe before which the odometry is cut; see `closure_selection.FindCut`."""
    frames = np.arange(since + 1, since + 1 + len(onwards))[-SEARCH:]
    return _find_turning_point(graph, frames, poses, onwards[-SEARCH:], carried)


def _find_turning_point(
    graph: KeyframeGraph, frames: np.ndarray, poses: np.ndarray, onwards: np.ndarray, carried: np.ndarray
) -> int:
    """The keyframe of `frames` [n] from which views fit better at the carried poses than at the odometry's.

    Args:
        poses: [N, 3] of older keyframes. onwards: [n, 3] poses of `frames` by odometry.
    """
    stays, goes = (
        np.array(
            [_misfit(graph, frame, pose, poses) for frame, pose in zip(frames.tolist(), rows, strict=True)]
        )
        for rows in (onwards, compose(carried, onwards))
    )
    # With a break before frames[k], those before k stay and the others are carried.
    cost = np.concatenate([[0], np.cumsum(stays)[:-1]]) + np.cumsum(goes[::-1])[::-1]
    return int(frames[len(cost) - 1 - np.argmin(cost[::-1])])


def _misfit(graph: KeyframeGraph, frame: int, pose: np.ndarray, poses: np.ndarray) -> float:
    """Misfit of a keyframe's view at `pose` [3] against the older keyframes near it, at poses [N, 3]."""
    old = poses[: max(frame - graph.guard, 0)]
    near = np.flatnonzero(np.hypot(*(old - pose)[:, :2].T) < 1.5 * graph.cell)
    return graph.misfit(frame, near, np.cos(old[near, 2] - pose[2]) < 0)
