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
    """The run with its pieces where a picture shows them: `run.main` stays, in the frame of the map; the
    others are aligned to the truth as that one is or, where that is unknown, stand beside the one before.
    Within a piece nothing changes; a run of one piece is left as it is. Experiences and online poses move
    with their pieces."""
    of_node = run.node_piece
    if not len(run.piece):
        return run
    if not len(of_node):
        of_node = np.where(run.created < 0, run.main, run.piece[run.created])
    numbers, sizes = np.unique(run.piece, return_counts=True)
    order = [run.main, *numbers[np.argsort(-sizes, kind="stable")], *np.unique(of_node)]
    pieces = [one for one in dict.fromkeys(map(int, order)) if one in run.piece or one in of_node]
    if len(pieces) < 2:
        return run
    final, online, nodes = run.final.copy(), run.online.copy(), run.nodes.copy()
    rows, to_map, shown = truth_rows(run), None, list[np.ndarray]()
    for one in pieces:
        steps, placed = run.piece == one, of_node == one
        known, moved = rows[steps[rows]], np.zeros(3)
        inside = np.concatenate([final[steps], nodes[placed]])
        if to_map is not None and run.truth is not None and len(known):
            moved = compose(to_map, align(final[known], run.truth[known]))
        elif shown:
            right = max(part[:, 0].max() for part in shown) + GAP * np.ptp(shown[0][:, 0])
            moved[:2] = [right, shown[0][:, 1].min()] - inside[:, :2].min(axis=0)
        for poses, own in ((final, steps), (online, steps), (nodes, placed)):
            poses[own] = compose(moved, poses[own])
        shown.append(compose(moved, inside))
        if to_map is None and run.truth is not None and len(known):
            to_map = align(run.truth[known], final[known])
    return run._replace(final=final, online=online, nodes=nodes, node_piece=of_node)


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
