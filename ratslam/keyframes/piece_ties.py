"""Ties of the newest piece of a map to another one, by a rule that the map is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ratslam.keyframes.archive import Archive
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.loop_closures import Candidate, ClosureLog, Verdict

TIE_EVERY = 16
"""Keyframes between two trials."""
FindTie = Callable[[KeyframeGraph, ClosureLog, Archive], Sequence[Candidate]]
"""Finds closures that tie the newest piece of a map to another one; none if the views do not decide."""


def no_tie(graph: KeyframeGraph, log: ClosureLog, archive: Archive) -> Sequence[Candidate]:
    """The rule by which pieces stay apart."""
    return []


def tie_newest_piece(graph: KeyframeGraph, log: ClosureLog, archive: Archive, find: FindTie) -> bool:
    """Accepts a tie, if a trial is due and finds one, as one closure sequence; moves the pieces together.

    Returns:
        whether there was one.
    """
    if graph.ever % TIE_EVERY or not graph.begins.rows.any() or not graph.pieces(log)[-1]:
        return False
    closures = find(graph, log, archive)
    for k, candidate in enumerate(closures):
        sequence = log.add(candidate, k > 0)
        archive.add(candidate, k > 0, graph)
        log.judge(sequence, Verdict.ACCEPTED)
    if closures:
        graph.place_pieces(log)
    return bool(closures)
