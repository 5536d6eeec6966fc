"""Joins pieces of a map by closure sequences between them."""

from __future__ import annotations

import numpy as np

from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.keyframes.piece_ties import TieClaim, ties_of_pieces
from tactile.base.se2 import compose, inverse


def spans_pieces(graph: KeyframeGraph, log: ClosureLog) -> np.ndarray:
    """[R] bool: sequences that have a candidate between pieces of the map that nothing joins."""
    if not graph.begins.rows.any():
        return np.zeros(log.sequences, bool)
    return _spans(graph.pieces(log), log)


def spans_beginnings(graph: KeyframeGraph, log: ClosureLog) -> np.ndarray:
    """[R] bool: sequences that have a candidate across the beginning of a piece, joined or not."""
    return _spans(np.cumsum(graph.begins.rows), log)


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


def join_pieces(graph: KeyframeGraph, log: ClosureLog, candidate: Candidate) -> bool:
    """Joins the two pieces of a candidate if the sequences between them suffice (`ties_of_pieces`): accepts
    these and moves the piece that began later; whether they are joined now."""
    piece = graph.pieces(log)
    pair = sorted((int(piece[candidate.match]), int(piece[candidate.keyframe])))
    ties = ties_of_pieces(_claims(graph, log, piece, pair), graph.cell)
    for sequence in ties:
        log.judge(sequence, Verdict.ACCEPTED)
    if ties:
        graph.place_pieces(log)
    return bool(ties)


def _claims(graph: KeyframeGraph, log: ClosureLog, piece: np.ndarray, pair: list[int]) -> list[TieClaim]:
    """The claims of all open sequences between a pair of pieces, by their middle candidates."""
    scores, claims = log.scores(), []
    open_ = (log.verdicts() == Verdict.OPEN) & (log.sizes() >= graph.config.min_length) & (log.left() > 0)
    for sequence in np.flatnonzero(open_).tolist():
        members = log.members(sequence)
        frame, match, shift, _ = members[len(members) // 2].tolist()
        if sorted((int(piece[frame]), int(piece[match]))) != pair:
            continue
        turn = np.array([0.0, 0.0, -shift * graph.sector_angle])
        place, later = compose(graph.pose.rows[match], turn), graph.pose.rows[frame]
        motion = compose(place, inverse(later))  # of the piece of `frame`
        if piece[frame] == pair[0]:
            motion, later = inverse(motion), place
        claims.append(TieClaim(sequence, float(scores[sequence]), later.copy(), motion))
    return claims
