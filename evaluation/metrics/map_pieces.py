"""Metrics of a map in pieces, whose relative poses nothing in the map determines.

A robot that was carried away begins a new piece; a loop closure with an older piece joins the two. The map
defines no motion between steps in different pieces, so an error of such a pair says nothing about it.
"""

from __future__ import annotations

import numpy as np

from evaluation.metrics.energy_metric import Energy, energy_all_pairs
from evaluation.metrics.run_arrays import RunArrays, truth_rows
from evaluation.metrics.trajectory import align, position_errors
from tactile.base.se2 import compose

FAR = 2.0
"""Distance of a jump that no correction within a piece makes, in diagonals of the box of dead reckoning."""
GAP = 0.1
"""Distance between two pieces in a picture, as a share of the width of the first one."""


def energy_within_pieces(estimate: np.ndarray, truth: np.ndarray, piece: np.ndarray) -> Energy:
    """Energy over every pair of steps i < j in the same piece.

    Args:
        estimate: [T, 3] poses. truth: [T, 3] true poses. piece: [T] the piece of each step, int.
    """
    found = [energy_all_pairs(estimate[piece == one], truth[piece == one]) for one in np.unique(piece)]
    known = [part for part in found if part.pairs]
    if len(known) == 1:
        return known[0]
    pairs = sum(part.pairs for part in known)
    if not pairs:
        return Energy(np.nan, np.nan, 0)
    trans2 = sum(part.trans2 * part.pairs for part in known) / pairs
    rot2 = sum(part.rot2 * part.pairs for part in known) / pairs
    return Energy(trans2, rot2, pairs)


def ate_within_pieces(estimate: np.ndarray, truth: np.ndarray, piece: np.ndarray) -> float:
    """Root mean square position error, m, after an alignment of each piece by itself; NaN without steps."""
    if not len(piece):
        return np.nan
    errors = [position_errors(estimate[piece == one], truth[piece == one]) for one in np.unique(piece)]
    return float(np.sqrt((np.concatenate(errors) ** 2).mean()))


def arrange_pieces(run: RunArrays) -> RunArrays:
    """The run with its pieces where a picture shows them: each aligned to the truth by itself or, where that
    is unknown, beside the one before. Within a piece nothing changes; a run of one piece is left as it is.
    Online poses are moved with the pieces in which their steps end up."""
    if not run.has_pieces:
        return run
    final, online, nodes = run.final.copy(), run.online.copy(), run.nodes.copy()
    of_node = run.piece[run.created]
    rows, right = truth_rows(run), 0.0
    for one in np.unique(run.piece):
        steps = run.piece == one
        known = rows[steps[rows]]
        moved = np.array([right, 0.0, 0.0]) - [*final[steps, :2].min(axis=0), 0.0]
        if run.truth is not None and len(known):
            moved = align(final[known], run.truth[known])
        final[steps], online[steps] = compose(moved, final[steps]), compose(moved, online[steps])
        nodes[of_node == one] = compose(moved, nodes[of_node == one])
        right = final[steps, 0].max() + GAP * np.ptp(final[:, 0][run.piece == run.piece[0]])
    return run._replace(final=final, online=online, nodes=nodes)


def tie_jump(poses: np.ndarray, odometry: np.ndarray) -> tuple[int, float] | None:
    """The step at which online poses jump farther than a correction within a piece could move them, and how
    far, m; None without one. A piece lies far from all others until it is tied to them.

    Args:
        poses: [T, 3] online, each in the map of its time. odometry: [T, 3] dead reckoning.
    """
    if len(poses) < 2:
        return None
    moved = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    step, reach = int(moved.argmax()) + 1, np.hypot(*np.ptp(odometry[:, :2], axis=0))
    return (step, float(moved.max())) if moved.max() > FAR * reach > 0 else None


def unjoined_share(piece: np.ndarray) -> float:
    """Share of the steps outside the largest piece; NaN without steps.

    Args:
        piece: [T] the piece of each step, int.
    """
    _, steps = np.unique(piece, return_counts=True)
    return float(1 - steps.max() / len(piece)) if len(piece) else np.nan
