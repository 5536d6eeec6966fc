"""Ties of the newest piece of a map to older keyframes, by a rule that the map is given.

A tie is tried again while its piece is young: one that the views of later keyframes contradict is
undone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from ratslam.mapping.archive import Archive
from ratslam.mapping.ground import LearnedOdds
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.verification import spans_beginnings

TIE_EVERY = 4
"""Keyframes between two trials."""
YOUNG = 400
"""Number of keyframes of a piece up to which its tie is tried."""


Tie = tuple[float, Sequence[Candidate]]
"""A placement of the newest piece: its log-odds less the logarithm of the number of places (where those of
another placement are within half of `tie_log_odds`, the difference to the largest of these), and the closures
that it implies."""
FindTie = Callable[[KeyframeGraph, ClosureLog, Archive, LearnedOdds], Tie | None]
"""Finds the best placement of the keyframes since the newest beginning among those before, and keeps the
odds that it learns for these; None without any."""


def tie_newest_piece(
    graph: KeyframeGraph, log: ClosureLog, archive: Archive, odds: LearnedOdds, find: FindTie
) -> bool:
    """If a trial is due: ties the newest piece where the evidence suffices, or undoes its tie where the
    views contradict it.

    Args:
        odds: of the map's pieces, learned so far.

    Returns:
        whether the map has changed.
    """
    starts = np.flatnonzero(graph.begins.rows)
    if graph.total % TIE_EVERY or not len(starts) or graph.count - starts[-1] > YOUNG:
        return False
    log_odds, closures = find(graph, log, archive, odds) or (-np.inf, ())
    begins = graph.begins.rows.copy()
    # Accepted sequences between keyframes before the newest beginning and since.
    begins[: starts[-1]] = False
    across = np.flatnonzero(spans_beginnings(begins, log) & (log.verdicts() == Verdict.ACCEPTED))
    if not len(across):
        if log_odds < graph.config.tie_log_odds:
            return False
        for k, candidate in enumerate(closures):
            sequence = log.add(candidate, k > 0)
            archive.add(candidate, k > 0, graph)
            log.judge(sequence, Verdict.ACCEPTED)
    elif log_odds >= graph.config.tie_log_odds / 2:
        return False
    for sequence in across.tolist():
        log.judge(sequence, Verdict.UNDONE)
    graph.place_pieces(log)
    return True
