"""Rules by which a map accepts closure sequences: by evidence (whiskers), by odds (views, ids).

The odds of a sequence are those of its score among the false sequences of this session (the null), times the
likelihood ratio of its place under raw odometry (`OdometryScan`), with the calibration for which the other
sequences vote; or under the map, where its covariance is narrow enough to be linear. Nobody says which
sequences are false: each counts as false by the probability that it is, as judged last. A sequence of score s
is then true with odds (T e^(-s/m) / m) / (n e^(-(s - s0)/t) / t), with n false sequences above s0 and their
mean excess t: one step of expectation maximisation (Dempster, Laird & Rubin 1977) of a mixture each time.

The vote on the calibration is held before any sequence is accepted: a true sequence favours the heading
biases and turn errors with which odometry leads to its place, a false one none that others favour as well.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import expit

from ratslam.core.arrays import Checkpointed, GrowableArray
from ratslam.mapping.closure_judge import AT_ONCE, judge_sequences
from ratslam.mapping.ground import LearnedOdds
from ratslam.mapping.loop_closures import CONFIRMED_WEIGHT, Candidate, Verdict
from ratslam.mapping.map_solution import cheapest_map
from ratslam.mapping.map_state import MapState
from ratslam.mapping.odometry_scan import OdometryScan
from ratslam.mapping.optimizer import CalibrationPrior
from ratslam.mapping.verification import (
    SEARCH,
    find_turning_point,
    judge_by_map,
    map_distance,
    spans,
    turn_on_spot,
)
from tactile.base.se2 import compose, inverse


class Acceptance(Checkpointed, ABC):
    """A rule with what it has learned."""

    def learn_bias(self, state: MapState, prior: CalibrationPrior) -> None:
        """Takes over the prior with the heading bias that the views show."""
        state.adopt_prior(prior)

    @abstractmethod
    def judge(self, state: MapState, sequence: int, candidate: Candidate) -> bool:
        """Judges after `candidate` was added to `sequence`; whether any sequence was accepted."""

    def review(self, state: MapState) -> bool:
        """Judges again after the map has changed; whether any sequence was accepted."""
        return False

    def solution(self, state: MapState) -> MapState:
        """The map as it would be if the session ended now; leaves `state` unchanged."""
        return state.solved()


class AcceptByEvidence(Acceptance):
    """A sequence is accepted by its evidence less what the map's covariance says against it; where
    sequences are selected later, only if it is likely to be true."""

    def judge(self, state: MapState, sequence: int, candidate: Candidate) -> bool:
        config, log, piece = state.config, state.log, state.pieces()
        score, length = log.score(sequence), len(log.members(sequence))
        if log.verdict(sequence) != Verdict.OPEN or piece[candidate.keyframe] != piece[candidate.match]:
            return False
        if length < config.min_length or score < config.min_score:
            return False
        distance = map_distance(state, candidate) if state.ablation.verify else 0.0
        fits = distance < config.max_distance and score - distance / 2 >= config.min_score
        accepted = fits
        if fits and config.select_every:  # an unlikely sequence waits for the next selection
            (odds,) = judge_sequences(state, np.array([sequence]))
            accepted = not odds < AT_ONCE
        log.judge(sequence, Verdict.ACCEPTED if accepted else Verdict.OPEN, distance)
        carried = config.may_be_carried and not config.select_every  # selection places its own cuts
        broken = carried and length >= config.break_length and score >= config.break_score
        if not fits and broken and distance >= config.max_distance:
            _break_odometry(state, sequence)
        return log.verdict(sequence) == Verdict.ACCEPTED


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
REVIEWS = 4
"""Largest number of reviews when the final map is made."""

SHRINK = 2.0
"""Standard deviations of the vote by which its mean must differ from the prior's to count."""
LEAST_TURN_ERROR = 0.002
"""Least standard deviation of the turn error, rad/rad."""


def vote(
    grid: np.ndarray, prior: CalibrationPrior, log_ratios: np.ndarray, score_odds: np.ndarray, least_sd: float
) -> tuple[CalibrationPrior, CalibrationPrior, np.ndarray]:
    """The vote of R sequences on the calibrations of `grid` [G, 2], rad/m and rad/rad.

    Args:
        log_ratios: [R, G] of `OdometryScan`. score_odds: [R] log odds by their scores. least_sd: least
            standard deviation of the belief in the bias, rad/m.

    Returns:
        heading bias and turn error, shrunk towards the prior; the same, not shrunk; [R] log odds that each
        sequence is true, with the calibration that the prior and the others vote for.
    """
    votes = np.logaddexp(0.0, score_odds[:, None] + log_ratios)
    # log prior density of the calibrations, up to a constant
    log = -0.5 * ((grid[:, 0] - prior.bias) / prior.bias_sd) ** 2
    if prior.turn_error_sd > 0:
        log = log - 0.5 * ((grid[:, 1] - prior.turn_error) / prior.turn_error_sd) ** 2
    total = log + votes.sum(axis=0)
    others = total - votes
    others = others - _log_sum(others)[:, None]
    share = np.exp(total - _log_sum(total))
    bias, bias_mean, bias_sd = _belief(share, grid[:, 0], prior.bias, least_sd)
    turn, turn_mean, turn_sd = _belief(share, grid[:, 1], prior.turn_error, LEAST_TURN_ERROR)
    turn_sd = turn_sd if prior.turn_error_sd > 0 else 0.0
    belief = CalibrationPrior(bias, bias_sd, turn, turn_sd)
    mean = CalibrationPrior(bias_mean, bias_sd, turn_mean, turn_sd)
    return belief, mean, score_odds + _log_sum(others + log_ratios)


def _log_sum(values: np.ndarray) -> np.ndarray:
    """[...] logarithm of the sum of the exponentials of finite values [..., G]; scipy's function, which
    also handles other values, needs several times as long for few of them."""
    largest = values.max(axis=-1)
    return largest + np.log(np.exp(values - largest[..., None]).sum(axis=-1))


def _belief(share: np.ndarray, values: np.ndarray, prior: float, least: float) -> tuple[float, float, float]:
    """Mean of values [G] with weights [G], shrunk towards the prior's; the mean itself; and the standard
    deviation about the shrunk mean."""
    mean = float(share @ values)
    sd = float(np.sqrt(share @ (values - mean) ** 2))
    off = mean - prior
    kept = prior + (off * max(0.0, 1 - (SHRINK * sd / off) ** 2) if off else 0.0)
    return kept, mean, max(float(np.hypot(sd, mean - kept)), least)


_Vote = tuple[np.ndarray, np.ndarray, CalibrationPrior, CalibrationPrior, np.ndarray]
"""The R sequences [R] that were compared with odometry, their log odds by score [R], and their vote on the
calibration (`vote`)."""


class AcceptByOdds(Acceptance):
    """Judges all open sequences. Odometry is compared on the keyframes as they were taken."""

    VALUES = ("_views_prior",)

    def __init__(self, state: MapState) -> None:
        self._scan = OdometryScan(state)
        self._log_ratio = GrowableArray((len(self._scan.grid),), np.float64)  # by calibration
        self._views_prior = state.prior

    def learn_bias(self, state: MapState, prior: CalibrationPrior) -> None:
        self._views_prior = prior
        # Sequences whose comparison does not cover the present prior are compared again.
        ratios = self._log_ratio.rows
        uncovered = np.isnan(ratios[:, self._scan.near(self._views_prior)]).any(axis=1)
        for sequence in np.flatnonzero(uncovered & np.isfinite(ratios).any(axis=1)).tolist():
            self._rate(state, sequence)
        state.adopt_prior(self._vote(state)[2])

    def judge(self, state: MapState, sequence: int, candidate: Candidate) -> bool:
        log = state.log
        while len(self._log_ratio.rows) < log.sequences:
            self._log_ratio.append(np.full(len(self._scan.grid), np.nan))
        length, accepted = int(log.sizes()[sequence]), log.verdict(sequence) == Verdict.ACCEPTED
        if length < state.config.min_length:
            return False
        # The middle of a growing sequence moves on slowly: it is compared anew only at lengths of at most
        # three significant bits.
        rest = max(length.bit_length() - 3, 0)
        if length == length >> rest << rest or length == state.config.min_length:
            self._rate(state, sequence)
        due = candidate.keyframe % REVIEW_EVERY == 0
        if accepted and not due:
            return False
        voted = self._vote(state)
        state.adopt_prior(voted[2])
        among = np.arange(log.sequences) if due else np.array([sequence])
        return self._accept(state, among, voted) or self._break(state, sequence)

    def review(self, state: MapState) -> bool:
        return self._accept(state, np.arange(state.log.sequences), self._vote(state))

    def solution(self, state: MapState) -> MapState:
        trial, found = state.copy(), state.trial()
        sequences, _, belief, mean, _ = self._vote(trial)
        if len(sequences):
            trial.prior = belief
            for _ in range(REVIEWS):
                if not self.review(trial):
                    break
                trial.optimise()
        solved = cheapest_map(trial, [mean, trial.prior]) if len(trial.log.accepted_rows()) else trial
        found.take_fit(solved.fit())
        found.log, found.cut = solved.log, solved.cut
        return found

    def restore(self, arrays: dict[str, np.ndarray]) -> None:
        super().restore(arrays)
        self._scan.clear()

    def _vote(self, state: MapState) -> _Vote:
        log, near = state.log, self._scan.near(self._views_prior)
        known = np.isfinite(self._log_ratio.rows[:, near]).all(axis=1)
        sequences = np.flatnonzero(known & (log.verdicts()[: len(known)] != Verdict.UNDONE))
        confirmed = (log.verdicts() == Verdict.ACCEPTED) & (log.sequence_weights() > CONFIRMED_WEIGHT)
        false = 1 - expit(np.nan_to_num(log.log_odds(), nan=-np.inf))
        null = estimate_null(log.scores(), false, state.count)
        score_odds = log_odds(log.scores(), *null, float(confirmed.sum()))[sequences]
        least = state.config.bias_least / state.cell
        grid, ratios = self._scan.grid[near], self._log_ratio.rows[sequences][:, near]
        return sequences, score_odds, *vote(grid, self._views_prior, ratios, score_odds, least)

    def _accept(self, state: MapState, among: np.ndarray, voted: _Vote) -> bool:
        """Accepts every open sequence of `among` whose odds, by raw odometry or by the map, are high
        enough; whether there was any."""
        log, (sequences, score_odds, _, _, odds) = state.log, voted
        open_ = (log.verdicts()[sequences] == Verdict.OPEN) & np.isin(sequences, among)
        open_ &= ((log.left() > 0) & ~spans(state.pieces(), log))[sequences]
        # No odometry prior at the start of a piece: only the map judges there.
        accepted = (odds >= MIN_LOG_ODDS) & ~spans(np.cumsum(state.begins.rows), log)[sequences]
        undecided = open_ & ~accepted & (score_odds + np.log(state.count) > 0)
        doubtful = open_ & accepted & state.config.may_be_carried
        if (undecided | doubtful).any():
            covariance = state.covariance()
            for k in np.flatnonzero(undecided | doubtful).tolist():
                member = log.members(int(sequences[k]))[-1]
                log_ratio, distance, position_sd, heading_sd = judge_by_map(state, covariance, member)
                if undecided[k] and heading_sd <= LINEAR_HEADING:
                    by_map = score_odds[k] + log_ratio
                    near = position_sd < NEAR * state.cell
                    odds[k] = max(odds[k], by_map)
                    accepted[k] = odds[k] >= MIN_LOG_ODDS or (near and by_map >= 0)
                if state.config.may_be_carried:  # no evidence is too much for a sequence after a cut
                    accepted[k] &= distance < state.config.max_distance
        log.raise_log_odds(sequences, odds)
        for sequence in sequences[open_ & accepted].tolist():
            log.judge(sequence, Verdict.ACCEPTED)
        return bool((open_ & accepted).any())

    def _break(self, state: MapState, sequence: int) -> bool:
        """Cuts the odometry where a long sequence contradicts it, if the robot may be carried."""
        config, log = state.config, state.log
        long = log.sizes()[sequence] >= config.break_length and log.score(sequence) >= config.break_score
        apart = bool(spans(state.pieces(), log)[sequence])
        if not (config.may_be_carried and long) or apart or log.verdict(sequence) != Verdict.OPEN:
            return False
        _break_odometry(state, sequence)
        for other in np.flatnonzero(np.isfinite(self._log_ratio.rows).any(axis=1)).tolist():
            self._rate(state, other)
        return True

    def _rate(self, state: MapState, sequence: int) -> None:
        """Compares a sequence, by its middle member, with raw odometry."""
        if state.merged:
            state.merged.follow(state)
        whole = state.unmerged
        members = whole.log.members(sequence)
        if len(members):
            near = self._scan.near(self._views_prior, WIDE)
            self._log_ratio.rows[sequence] = self._scan.log_ratios(whole, members[len(members) // 2], near)


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


def estimate_null(scores: np.ndarray, false: np.ndarray, keyframes: int) -> tuple[np.ndarray, np.ndarray]:
    """The null of each of R sequences in a session of so many keyframes, from the others: the number [R] of
    false sequences above `LEAST_SCORE`, and their mean excess [R] over it.

    Args:
        scores: [R]. false: [R] probabilities that they are false.
    """
    counted = np.where(scores >= LEAST_SCORE, false, 0.0)
    above = counted * (scores - LEAST_SCORE)
    others, excess = counted.sum() - counted, above.sum() - above
    mean = (excess + PRIOR_COUNT * PRIOR_EXCESS) / (others + PRIOR_COUNT)
    number = keyframes * (PRIOR_SEQUENCES + others) / (PRIOR_KEYFRAMES + keyframes)
    # False sequences stronger than true ones would let evidence lower the odds.
    return number, np.minimum(mean, TRUE_MEAN)


def log_odds(scores: np.ndarray, number: np.ndarray, excess: np.ndarray, true_count: float) -> np.ndarray:
    """[R] log odds that sequences with these scores [R] are true, before the map is asked.

    Args:
        number, excess: see `estimate_null`. true_count: number of true sequences known so far.
    """
    true = np.log(max(true_count, MIN_TRUE) / TRUE_MEAN) - scores / TRUE_MEAN
    return true - np.log(number / excess) + (scores - LEAST_SCORE) / excess


def _break_odometry(state: MapState, sequence: int) -> None:
    """Cuts the odometry where the views show the break, and joins the parts by the sequence."""
    log, pose = state.log, state.pose.rows
    members = log.members(sequence)
    middle = members[len(members) // 2]
    found = turn_on_spot(pose[middle[1]], -middle[2] * state.sector_angle)
    carried = compose(found, inverse(pose[middle[0]]))
    # The first keyframe whose views fit better at the poses moved by `carried` [3].
    first = int(members[0, 0])
    anchored = log.table()[log.accepted_rows(), 0]
    began = int(np.flatnonzero(state.begins.rows[: first + 1]).max(initial=0))
    since = max(int(anchored[anchored < first].max(initial=0)) - state.config.max_gap, began)
    frames = np.arange(max(since, first - SEARCH, 1), first + 1)
    at = find_turning_point(state, frames, state.pose.rows, state.pose.rows[frames], carried)
    state.cut.rows[at] = sequence
    pose[at:] = compose(carried, pose[at:])
    log.reject(at, sequence)
    log.judge(sequence, Verdict.ACCEPTED)


TIE_EVERY = 4
"""Keyframes between two trials of a tie of the newest piece to older keyframes."""
YOUNG = 400
"""Number of keyframes of a piece up to which its tie is tried: one that later views contradict is undone."""

Tie = tuple[float, Sequence[Candidate]]
"""A placement of the newest piece: its log-odds less the logarithm of the number of places (where those of
another placement are within half of `tie_log_odds`, the difference to the largest of these), and the closures
that it implies."""
FindTie = Callable[[MapState, LearnedOdds], Tie | None]
"""Finds the best placement of the keyframes since the newest beginning among those before, and keeps the
odds that it learns for these; None without any."""


def tie_newest_piece(state: MapState, find: FindTie, learned: LearnedOdds) -> bool:
    """If a trial is due: ties the newest piece where the evidence suffices, or undoes its tie where the
    views contradict it; whether the map has changed."""
    log, starts = state.log, np.flatnonzero(state.begins.rows)
    if state.total % TIE_EVERY or not len(starts) or state.count - starts[-1] > YOUNG:
        return False
    log_odds, closures = find(state, learned) or (-np.inf, ())
    # Accepted sequences between keyframes before the newest beginning and since.
    newest = np.arange(state.count) >= starts[-1]
    across = np.flatnonzero(spans(newest, log) & (log.verdicts() == Verdict.ACCEPTED))
    if not len(across):
        if log_odds < state.config.tie_log_odds:
            return False
        state.add_accepted(closures)
    elif log_odds >= state.config.tie_log_odds / 2:
        return False
    for sequence in across.tolist():
        log.judge(sequence, Verdict.UNDONE)
    state.place_pieces()
    return True
