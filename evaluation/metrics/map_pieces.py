"""Metrics of a map in pieces, whose relative poses nothing in the map determines.

A robot that was carried away begins a new piece; a loop closure with an older piece joins the two. The map
defines no motion between steps in different pieces, so an error of such a pair says nothing about it.
"""

from __future__ import annotations

import numpy as np

from evaluation.metrics.energy_metric import Energy, energy_all_pairs


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


def unjoined_share(piece: np.ndarray) -> float:
    """Share of the steps outside the largest piece; NaN without steps.

    Args:
        piece: [T] the piece of each step, int.
    """
    _, steps = np.unique(piece, return_counts=True)
    return float(1 - steps.max() / len(piece)) if len(piece) else np.nan
