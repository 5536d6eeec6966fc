"""Rules by which a map accepts closure sequences.

Acceptance of closure sequences by the odds that they are true.

The odds of a sequence are those of its score among the false sequences of this session (the null), times how
well odometry foretold its place among all others (`OdometryScan`), with the calibration for which the other
sequences vote (`vote`); or how well the map foretells it where its covariance is narrow enough to be linear.
The rules are ours.

**The null.** Nobody says which sequences are false, but all have odds: each of the others counts as false by
the probability that it is, as judged last, and as false while it is not judged. A sequence of score s is then
true with odds

    true sequences per score / false sequences per score = (T e^(-s/m) / m) / (n e^(-(s - s0)/t) / t)

with n false sequences above s0 and their mean excess t. This is expectation maximisation (Dempster, Laird and
Rubin 1977) of a mixture, one step whenever odds are asked for.

**The vote** on the calibration of the odometry is held before any sequence is accepted. Each is true with
some odds, and if it is true it favours the heading biases and turn errors with which odometry leads to its
place (`ratslam.mapping.odometry_scan`). A false sequence favours none that others favour as well.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from ratslam.core.arrays import GrowableArray
from ratslam.core.checkpoint import Checkpointed
from ratslam.mapping.archive import Archive
from ratslam.mapping.closure_judge import AT_ONCE, judge_newest
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.map_solution import MapSolution, cheapest_map, solved_map
from ratslam.mapping.odometry_scan import OdometryScan
from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.mapping.verification import (
    break_odometry,
    joins_pieces,
    judge_by_map,
    spans_beginnings,
    spans_pieces,
    verify_sequence,
)


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

SHRINK = 2.0
"""Standard deviations of the vote by which its mean must differ from the prior's to count."""
LEAST_TURN_ERROR = 0.002
"""Least standard deviation of the turn error, rad/rad."""


class CalibrationVote(NamedTuple):
    """Result of a vote.

    Attributes:
        belief: heading bias and turn error, shrunk towards the prior. mean: the same, not shrunk. odds: [R]
            log odds that each sequence is true, with the calibration that the prior and the others vote for.
    """

    belief: CalibrationPrior
    mean: CalibrationPrior
    odds: np.ndarray


def vote(
    grid: np.ndarray,
    prior: CalibrationPrior,
    log_ratios: np.ndarray,
    score_odds: np.ndarray,
    least_bias_sd: float,
) -> CalibrationVote:
    """The vote of R sequences on the calibrations of `grid` [G, 2], rad/m and rad/rad.

    Args:
        log_ratios: [R, G] of `OdometryScan`. score_odds: [R] log odds by their scores. least_bias_sd: least
            standard deviation of the belief in the bias, rad/m.
    """
    votes = np.logaddexp(0.0, score_odds[:, None] + log_ratios)
    total = log_prior(grid, prior) + votes.sum(axis=0)
    others = total - votes
    others = others - _log_sum(others)[:, None]
    share = np.exp(total - _log_sum(total))
    bias, bias_mean, bias_sd = _belief(share, grid[:, 0], prior.bias, least_bias_sd)
    turn, turn_mean, turn_sd = _belief(share, grid[:, 1], prior.turn_error, LEAST_TURN_ERROR)
    turn_sd = turn_sd if prior.turn_error_sd > 0 else 0.0
    return CalibrationVote(
        CalibrationPrior(bias, bias_sd, turn, turn_sd),
        CalibrationPrior(bias_mean, bias_sd, turn_mean, turn_sd),
        score_odds + _log_sum(others + log_ratios),
    )


def log_prior(grid: np.ndarray, prior: CalibrationPrior) -> np.ndarray:
    """[G] log prior density of the calibrations `grid` [G, 2], up to a constant."""
    log = -0.5 * ((grid[:, 0] - prior.bias) / prior.bias_sd) ** 2
    if prior.turn_error_sd > 0:
        log = log - 0.5 * ((grid[:, 1] - prior.turn_error) / prior.turn_error_sd) ** 2
    return log


def _log_sum(values: np.ndarray) -> np.ndarray:
    """[...] logarithm of the sum of the exponentials of finite values [..., G]; scipy's function, which also
    handles other values, needs several times as long for few of them."""
    largest = values.max(axis=-1)
    return largest + np.log(np.exp(values - largest[..., None]).sum(axis=-1))


def _belief(
    share: np.ndarray, values: np.ndarray, prior: float, least_sd: float
) -> tuple[float, float, float]:
    """Mean of values [G] with weights [G], shrunk towards the prior's; the mean itself; and the standard
    deviation about the shrunk mean."""
    mean = float(share @ values)
    sd = float(np.sqrt(share @ (values - mean) ** 2))
    off = mean - prior
    kept = prior + (off * max(0.0, 1 - (SHRINK * sd / off) ** 2) if off else 0.0)
    return kept, mean, max(float(np.hypot(sd, mean - kept)), least_sd)


class Ballot(NamedTuple):
    """R sequences [R], their log odds by score [R], and their vote on the calibration."""

    sequences: np.ndarray
    score_odds: np.ndarray
    result: CalibrationVote


class AcceptByOdds(Acceptance):
    """Judges all open sequences. Odometry is compared on the keyframes as they were taken, of `archive` once
    some are merged."""

    VALUES = ("_views_prior",)

    def __init__(self, graph: KeyframeGraph, archive: Archive) -> None:
        self._archive, self._scan = archive, OdometryScan(graph)
        self._log_ratio = GrowableArray((len(self._scan.grid),), np.float64)  # by calibration
        self._views_prior = graph.prior

    def learn_bias(self, graph: KeyframeGraph, log: ClosureLog, prior: CalibrationPrior) -> None:
        self._views_prior = prior
        # Compares those sequences again whose comparison does not cover the present prior.
        ratios = self._log_ratio.rows
        uncovered = np.isnan(ratios[:, self._scan.near(self._views_prior)]).any(axis=1)
        for sequence in np.flatnonzero(uncovered & np.isfinite(ratios).any(axis=1)).tolist():
            self._rate(graph, log, sequence)
        believe(graph, log, self._vote(graph, log).result.belief)

    def judge(self, graph: KeyframeGraph, log: ClosureLog, sequence: int, candidate: Candidate) -> bool:
        while len(self._log_ratio.rows) < log.sequences:
            self._log_ratio.append(np.full(len(self._scan.grid), np.nan))
        length, accepted = log.size(sequence), log.verdict(sequence) == Verdict.ACCEPTED
        if length < graph.config.min_length:
            return False
        if is_round(length) or length == graph.config.min_length:
            self._rate(graph, log, sequence)
        due = candidate.keyframe % REVIEW_EVERY == 0
        if accepted and not due:
            return False
        ballot = self._vote(graph, log)
        believe(graph, log, ballot.result.belief)
        among = np.arange(log.sequences) if due else np.array([sequence])
        return self._accept(graph, log, among, ballot) or self._break(graph, log, sequence)

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
        false = 1 - expit(np.nan_to_num(log.log_odds(), nan=-np.inf))
        null = estimate_null(log.scores(), false, graph.count)
        score_odds = log_odds(log.scores(), null, float(confirmed.sum()))[sequences]
        least = graph.config.bias_least / graph.cell
        grid, ratios = self._scan.grid[near], self._log_ratio.rows[sequences][:, near]
        return Ballot(sequences, score_odds, vote(grid, self._views_prior, ratios, score_odds, least))

    def _accept(self, graph: KeyframeGraph, log: ClosureLog, among: np.ndarray, ballot: Ballot) -> bool:
        """Accepts every open sequence of `among` whose odds, by raw odometry or by the map, are high enough;
        whether there was any."""
        sequences, score_odds, result = ballot
        odds, open_ = result.odds, log.verdicts()[sequences] == Verdict.OPEN
        open_ &= (
            np.isin(sequences, among) & (log.left() > 0)[sequences] & ~spans_pieces(graph, log)[sequences]
        )
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
        long = log.size(sequence) >= config.break_length and log.score(sequence) >= config.break_score
        apart = bool(spans_pieces(graph, log)[sequence])
        if not (config.may_be_carried and long) or apart or log.verdict(sequence) != Verdict.OPEN:
            return False
        break_odometry(graph, log, sequence)
        for other in np.flatnonzero(np.isfinite(self._log_ratio.rows).any(axis=1)).tolist():
            self._rate(graph, log, other)
        return True

    def _rate(self, graph: KeyframeGraph, log: ClosureLog, sequence: int) -> None:
        """Compares a sequence, by its middle member, with raw odometry."""
        if self._archive.begun:
            self._archive.follow(MapSolution(graph.fit(), log, graph.cut), graph)
            graph, log = self._archive.graph, self._archive.log
        members = log.members(sequence)
        if len(members):
            near = self._scan.near(self._views_prior, WIDE)
            self._log_ratio.rows[sequence] = self._scan.log_ratios(graph, members[len(members) // 2], near)


def is_round(length: int) -> bool:
    """Whether a length has at most three significant bits: the middle of a growing sequence is compared anew
    only then, because it moves on slowly."""
    return length == length >> (low := max(length.bit_length() - 3, 0)) << low


LEAST_SCORE = 2.0
"""Least score, s0, of a false sequence that counts."""
PRIOR_COUNT, PRIOR_EXCESS = 5.0, 7.0
"""The prior of the excess: the number of sequences that it counts as, and their mean excess over s0."""
PRIOR_SEQUENCES, PRIOR_KEYFRAMES = 3.0, 16.0
"""The gamma prior of the rate of false sequences: as many sequences in as many keyframes."""
TRUE_MEAN = 30.0
"""Mean score, m, of true sequences."""
MIN_TRUE = 5.0
"""Least number of true sequences, T, that is expected in a session."""


class NullModel(NamedTuple):
    """Number of false sequences above `LEAST_SCORE`, and their mean excess over it, [R] for each of R
    sequences."""

    number: np.ndarray
    excess: np.ndarray


def estimate_null(scores: np.ndarray, false: np.ndarray, keyframes: int) -> NullModel:
    """The null of each of R sequences in a session of so many keyframes, from the others.

    Args:
        scores: [R]. false: [R] probabilities that they are false.
    """
    counted = np.where(scores >= LEAST_SCORE, false, 0.0)
    above = counted * (scores - LEAST_SCORE)
    others, excess = counted.sum() - counted, above.sum() - above
    mean = (excess + PRIOR_COUNT * PRIOR_EXCESS) / (others + PRIOR_COUNT)
    number = keyframes * (PRIOR_SEQUENCES + others) / (PRIOR_KEYFRAMES + keyframes)
    # False sequences stronger than true ones would let evidence lower the odds.
    return NullModel(number, np.minimum(mean, TRUE_MEAN))


def log_odds(scores: np.ndarray, null: NullModel, true_count: float) -> np.ndarray:
    """[R] log odds that sequences with these scores [R] are true, before the map is asked.

    Args:
        true_count: number of true sequences known so far.
    """
    true = np.log(max(true_count, MIN_TRUE) / TRUE_MEAN) - scores / TRUE_MEAN
    return true - np.log(null.number / null.excess) + (scores - LEAST_SCORE) / null.excess
