"""Closure sequences between pieces of a map that nothing else joins."""

from __future__ import annotations

import numpy as np

from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog


def spans_pieces(graph: KeyframeGraph, log: ClosureLog) -> np.ndarray:
    """[R] bool: sequences that have a candidate between pieces of the map that nothing joins."""
    if not graph.begins.rows.any():
        return np.zeros(log.sequences, bool)
    return _spans(graph.pieces(log), log)


def spans_beginnings(begins: np.ndarray, log: ClosureLog) -> np.ndarray:
    """[R] bool: sequences that have a candidate across the beginning of a piece, joined or not.

    Args:
        begins: [N] bool, see `KeyframeGraph`.
    """
    return _spans(np.cumsum(begins), log)


def _spans(piece: np.ndarray, log: ClosureLog) -> np.ndarray:
    spans, table = np.zeros(log.sequences, bool), log.table()
    table = table[table[:, 5] >= 0]
    later, earlier, sequence = table[:, [0, 1, 5]].astype(int).T
    spans[sequence[piece[later] != piece[earlier]]] = True
    return spans


def joins_pieces(graph: KeyframeGraph, log: ClosureLog, candidate: Candidate) -> bool:
    """Whether a candidate is between pieces of the map that nothing joins."""
    if not graph.begins.rows.any():
        return False
    piece = graph.pieces(log)
    return bool(piece[candidate.keyframe] != piece[candidate.match])
