"""Rules by which a map accepts closure sequences."""

from __future__ import annotations

from abc import ABC, abstractmethod

from ratslam.core.checkpoint import Checkpointed
from ratslam.mapping.closure_judge import AT_ONCE, judge_newest
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.map_solution import MapSolution, solved_map
from ratslam.mapping.odometry_breaks import break_odometry
from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.mapping.piece_joining import joins_pieces
from ratslam.mapping.verification import verify_sequence


class Acceptance(Checkpointed, ABC):
    """A rule with what it has learned."""

    def learn_bias(self, graph: KeyframeGraph, log: ClosureLog, prior: CalibrationPrior) -> None:
        """Takes over the heading bias that the views show."""
        believe(graph, log, prior)

    @abstractmethod
    def judge(self, graph: KeyframeGraph, log: ClosureLog, sequence: int, candidate: Candidate) -> bool:
        """Judges after `candidate` was added to `sequence`; whether any sequence was accepted."""

    def review(self, graph: KeyframeGraph, log: ClosureLog) -> bool:
        """Judges again after the map has changed; whether any sequence was accepted."""
        return False

    def solution(self, graph: KeyframeGraph, log: ClosureLog) -> MapSolution:
        """The map as it would be if the session ended now; leaves graph and log unchanged."""
        return solved_map(graph, log)


def believe(graph: KeyframeGraph, log: ClosureLog, prior: CalibrationPrior) -> None:
    """Takes over a prior of the calibration; the poses follow its means until a closure fixes them."""
    graph.prior = prior
    means = prior.bias, prior.turn_error
    if not len(log.accepted_rows()) and (graph.bias, graph.turn_error) != means:
        graph.bias, graph.turn_error = means
        graph.dead_reckon()


class AcceptByEvidence(Acceptance):
    """A sequence is accepted by its evidence less what the map's covariance says against it; where sequences
    are selected later, only if it is likely to be true."""

    def judge(self, graph: KeyframeGraph, log: ClosureLog, sequence: int, candidate: Candidate) -> bool:
        if log.verdict(sequence) != Verdict.OPEN:
            return False
        if joins_pieces(graph, log, candidate):
            return False
        test = verify_sequence(graph, log, sequence, candidate)
        if test is None:
            return False
        fits = test.fits and self._is_likely(graph, log, sequence)
        log.judge(sequence, Verdict.ACCEPTED if fits else Verdict.OPEN, test.distance)
        if test.breaks_odometry:
            break_odometry(graph, log, sequence)
        return log.verdict(sequence) == Verdict.ACCEPTED

    def _is_likely(self, graph: KeyframeGraph, log: ClosureLog, sequence: int) -> bool:
        """False if a sequence should wait for the next selection."""
        if not graph.config.select_every:
            return True
        return not judge_newest(graph, log, sequence) < AT_ONCE
