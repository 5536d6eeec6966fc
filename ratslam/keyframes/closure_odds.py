"""Acceptance of closure sequences by the odds that they are true.

The odds of a sequence are those of its score under the null of this session (`null_model`), times how well
odometry foretold its place among all others (`odometry_scan`), with the calibration for which the other
sequences vote (`calibration_vote`); or how well the map foretells it where its covariance is narrow enough to
be linear. The rule is ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.core.backend import Evidence
from ratslam.core.growable_array import GrowableArray
from ratslam.keyframes.acceptance import Acceptance, believe
from ratslam.keyframes.calibration_vote import CalibrationVote, vote
from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.keyframes.map_solution import MapSolution, cheapest_map, solved_map
from ratslam.keyframes.null_model import estimate_null, log_odds
from ratslam.keyframes.odometry_breaks import break_odometry
from ratslam.keyframes.odometry_scan import OdometryScan
from ratslam.keyframes.optimizer import CalibrationPrior
from ratslam.keyframes.piece_joining import spans_beginnings, spans_pieces
from ratslam.keyframes.verification import continues_sequence, judge_by_map
from ratslam.recall.mirror import MIRROR

MIN_LOG_ODDS = 2.3
"""Least log odds of an accepted sequence: 10 to 1."""
LINEAR_HEADING = 0.4
"""Largest standard deviation of heading at which the map's covariance is trusted, rad."""
NEAR = 1.5
"""Largest standard deviation of position, cells, at which a sequence only confirms what the map says, and
even odds are enough."""
WIDE = 5.0
"""Standard deviations of the views' prior over which a sequence is compared, so that the prior may move."""
REVIEW_EVERY = 10
"""Keyframes after which all open sequences are judged again."""
CONFIRMED_WEIGHT = 0.5
"""Least robust weight of a sequence that counts as true in the null."""
REVIEWS = 4
"""Largest number of reviews when the final map is made."""


class Ballot(NamedTuple):
    """R sequences [R], their log odds by score [R], and their vote on the calibration."""

    sequences: np.ndarray
    score_odds: np.ndarray
    result: CalibrationVote


class AcceptByOdds(Acceptance):
    """Learns the null from the control's sequences, and judges all open sequences."""

    VALUES = ("_views_prior",)
    PARTS = ("_control",)

    def __init__(self, graph: KeyframeGraph) -> None:
        self._control = ClosureLog()
        self._scan = OdometryScan(graph)
        self._log_ratio = GrowableArray((len(self._scan.grid),), np.float64)  # by calibration
        self._views_prior = graph.prior

    def observe(self, graph: KeyframeGraph, evidence: Evidence) -> None:
        """Logs a candidate of the control."""
        posterior = float(evidence.mirror_posterior)
        if int(evidence.mirror_match) < 0 or posterior <= graph.config.candidate_posterior:
            return
        candidate = Candidate(
            graph.count - 1,
            int(evidence.mirror_match),
            int(evidence.mirror_shift),
            posterior,
            float(evidence.mirror_log_ratio),
        )
        self._control.add(candidate, continues_sequence(graph, self._control, candidate, MIRROR))

    def learn_bias(self, graph: KeyframeGraph, log: ClosureLog, prior: CalibrationPrior) -> None:
        self._views_prior = prior
        # Compares those sequences again whose comparison does not cover the present prior.
        ratios = self._log_ratio.rows
        uncovered = np.isnan(ratios[:, self._scan.near(self._views_prior)]).any(axis=1)
        for sequence in np.flatnonzero(uncovered & np.isfinite(ratios).any(axis=1)).tolist():
            self._rate(log, sequence)
        believe(graph, log, self._vote(graph, log).result.belief)

    def judge(self, graph: KeyframeGraph, log: ClosureLog, sequence: int, candidate: Candidate) -> bool:
        while len(self._log_ratio.rows) < log.sequences:
            self._log_ratio.append(np.full(len(self._scan.grid), np.nan))
        length = len(log.members(sequence))
        if length < graph.config.min_length:
            return False
        if is_round(length) or length == graph.config.min_length:
            self._rate(log, sequence)
        ballot = self._vote(graph, log)
        believe(graph, log, ballot.result.belief)
        due = candidate.keyframe % REVIEW_EVERY == 0
        among = np.arange(log.sequences) if due else np.array([sequence])
        accepted = self._accept(graph, log, among, ballot)
        return accepted or self._break(graph, log, sequence)

    def review(self, graph: KeyframeGraph, log: ClosureLog) -> bool:
        return self._accept(graph, log, np.arange(log.sequences), self._vote(graph, log))

    def solution(self, graph: KeyframeGraph, log: ClosureLog) -> MapSolution:
        graph, log = graph.copy(), log.copy()
        ballot = self._vote(graph, log)
        if len(ballot.sequences):
            graph.prior = ballot.result.belief
            for _ in range(REVIEWS):
                if not self.review(graph, log):
                    break
                graph.optimise(log)
        if not len(log.accepted_rows()):
            return solved_map(graph, log)
        return cheapest_map(graph, log, [ballot.result.mean, graph.prior])

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        """Replaces the whole state by that of `arrays`."""
        super().restore(arrays)
        self._scan.clear()

    def _vote(self, graph: KeyframeGraph, log: ClosureLog) -> Ballot:
        near = self._scan.near(self._views_prior)
        known = np.isfinite(self._log_ratio.rows[:, near]).all(axis=1)
        sequences = np.flatnonzero(known & (log.verdicts()[: len(known)] != Verdict.UNDONE))
        confirmed = (log.verdicts() == Verdict.ACCEPTED) & (log.sequence_weights() > CONFIRMED_WEIGHT)
        false = ~finds_true_places(self._control, log, graph.config.max_gap)
        null = estimate_null(self._control.scores()[false], graph.count)
        score_odds = log_odds(log.scores()[sequences], null, float(confirmed.sum()))
        least = graph.config.bias_least / graph.cell
        grid, ratios = self._scan.grid[near], self._log_ratio.rows[sequences][:, near]
        return Ballot(sequences, score_odds, vote(grid, self._views_prior, ratios, score_odds, least))

    def _accept(self, graph: KeyframeGraph, log: ClosureLog, among: np.ndarray, ballot: Ballot) -> bool:
        """Accepts every open sequence of `among` whose odds, by raw odometry or by the map, are high enough;
        whether there was any."""
        sequences, score_odds, result = ballot
        odds, open_ = result.odds, log.verdicts()[sequences] == Verdict.OPEN
        open_ &= np.isin(sequences, among) & ~spans_pieces(graph, log)[sequences]
        # Odometry foretells nothing where a piece begins: there only the map can.
        accepted = (odds >= MIN_LOG_ODDS) & ~spans_beginnings(graph.begins.rows, log)[sequences]
        undecided = open_ & ~accepted & (score_odds + np.log(graph.count) > 0)
        doubtful = open_ & accepted & graph.config.may_be_carried
        if (undecided | doubtful).any():
            covariance = graph.map_covariance(log)
            for k in np.flatnonzero(undecided | doubtful).tolist():
                claim = judge_by_map(graph, covariance, log.members(int(sequences[k]))[-1])
                if undecided[k] and claim.heading_sd <= LINEAR_HEADING:
                    by_map = score_odds[k] + claim.log_ratio
                    near = claim.position_sd < NEAR * graph.cell
                    odds[k] = max(odds[k], by_map)
                    accepted[k] = odds[k] >= MIN_LOG_ODDS or (near and by_map >= 0)
                if graph.config.may_be_carried:  # no evidence is too much for a sequence after a cut
                    accepted[k] &= claim.distance < graph.config.max_distance
        log.rate(sequences, odds)
        for sequence in sequences[open_ & accepted].tolist():
            log.judge(sequence, Verdict.ACCEPTED)
        return bool((open_ & accepted).any())

    def _break(self, graph: KeyframeGraph, log: ClosureLog, sequence: int) -> bool:
        """Cuts the odometry where a long sequence contradicts it, if the robot may be carried."""
        config = graph.config
        long = len(log.members(sequence)) >= config.break_length and log.score(sequence) >= config.break_score
        apart = bool(spans_pieces(graph, log)[sequence])
        if not (config.may_be_carried and long) or apart or log.verdict(sequence) != Verdict.OPEN:
            return False
        break_odometry(graph, log, sequence)
        for other in np.flatnonzero(np.isfinite(self._log_ratio.rows).any(axis=1)).tolist():
            self._rate(log, other)
        return True

    def _rate(self, log: ClosureLog, sequence: int) -> None:
        """Compares a sequence, by its middle member, with raw odometry."""
        members = log.members(sequence)
        if len(members):
            near = self._scan.near(self._views_prior, WIDE)
            self._log_ratio.rows[sequence] = self._scan.log_ratios(members[len(members) // 2], near)


def is_round(length: int) -> bool:
    """Whether a length has at most three significant bits: the middle of a growing sequence is compared anew
    only then, because it moves on slowly."""
    return length == length >> (low := max(length.bit_length() - 3, 0)) << low


def finds_true_places(control: ClosureLog, log: ClosureLog, gap: int) -> np.ndarray:
    """[R] bool, sequences of the control that find what accepted sequences find: the place is its own mirror
    image, so they do not show that different places are mistaken for each other.

    Args:
        gap: largest difference between the matches of one keyframe, keyframes.
    """
    accepted = log.table()[log.accepted_rows(), :2].astype(int)
    table = control.table()
    table = table[table[:, 5] >= 0]
    frame, match, sequence = table[:, 0].astype(int), table[:, 1].astype(int), table[:, 5].astype(int)
    found = np.full(max(frame.max(initial=0), accepted[:, 0].max(initial=0)) + 1, -gap - 1)
    found[accepted[:, 0]] = accepted[:, 1]
    same = np.abs(match - found[frame]) <= gap
    return 2 * np.bincount(sequence, same, control.sequences) > control.sizes()
