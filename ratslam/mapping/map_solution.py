"""The final map: its poses, the closure sequences selected, the breaks of the odometry, and how healthy it
is.

*Noise.* A false sequence accepted early bends the map, the bent map raises the noise learned, and with more
noise further false sequences fit. So where the noise seems too large, the sequences are selected once more
from dead reckoning with the noise at the start. Refusing closures can hide truly noisy odometry: a refused
sequence costs its whole evidence here, and ties keep the map that explains more closures (MacKay 1992).

*Claimed revisits.* A keyframe near older ones that face alike claims a revisit. Where it is right, the view
fits better there than elsewhere; where it is wrong, it does so by chance. The comparison is by ranks, so no
constant is in units of the sensor.

*Health.* A logistic regression on these claims, the strain of the odometry and the refused sequences gives
the probability that the map is worse than odometry (`python -m ratslam reproduce tables health`).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from functools import partial

import numpy as np
from scipy.special import expit

from ratslam.mapping.appearance import near_facing
from ratslam.mapping.closure_judge import judge_anew
from ratslam.mapping.closure_selection import (
    ACCEPTED_WEIGHT,
    FINE,
    STEPS,
    MapHypotheses,
    Selection,
    SelectionProblem,
    select_closures,
    select_closures_and_cuts,
)
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.map_state import MapState
from ratslam.mapping.odometry_calibration import HeadingNoise, learn_heading_noise, log_posterior
from ratslam.mapping.optimizer import CalibrationPrior, MapFit, System, solve
from ratslam.mapping.pieces import Place
from ratslam.mapping.verification import find_break, spans
from tactile.base.se2 import between, wrap

RADIUS = 2.0
"""Distance within which keyframes are near each other, cells."""
FACING = float(np.cos(0.5))
"""Cosine of the largest difference in heading of two keyframes that face alike."""
CONTROLS = np.arange(1, 9) / 9
"""Shares of the older keyframes by which those near a keyframe are moved on in memory, as controls."""
JUDGED = 150
"""Largest number of keyframes by whose claims a map is compared with others."""
SHAPE, DOUBTFUL = 4.0, 0.05
"""The rank u of right claims has the density `SHAPE` u^(`SHAPE` - 1), and a share of uniform ones."""
ALONE = 5.0
"""Number of successive keyframes whose views count as one, because they are alike."""


def claimed_revisits(
    state: MapState, poses: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """The claims of poses [N, 3] of the keyframes; at most `most` keyframes are examined, spread evenly.

    Returns:
        of each of n claims its keyframe [n], the first of the older keyframes near it, of one pass [n], and
        the share [n] of the controls that its view fits worse than these, 0..1; ties count half; 0.5 by
        chance (a control is as many keyframes elsewhere among the older ones, in the same order); and how
        many keyframes were examined.
    """
    first, count = state.guard + 1, len(poses)
    frames = np.unique(np.linspace(first, count - 1, max(min(count - first, most), 0)).astype(int))
    facing = near_facing(poses, frames, state.guard, RADIUS * state.cell, FACING)
    row, near = np.nonzero(facing if state.half_turns else facing > 0)
    frame, reversed = frames[row], facing[row, near] < 0
    if not len(frame):
        return frame, near, np.zeros(0), len(frames)
    shares = np.concatenate([[0.0], CONTROLS])
    older = (frame - state.guard)[:, None]
    others = (near[:, None] + (older * shares).astype(int)) % older
    repeated = len(shares)
    misfits = state.misfits(np.repeat(frame, repeated), others.ravel(), np.repeat(reversed, repeated))
    passes = np.flatnonzero(np.diff(near, prepend=-1 - state.guard) > state.guard)
    passes = np.union1d(passes, np.flatnonzero(np.diff(frame, prepend=-1)))
    best = np.minimum.reduceat(misfits.reshape(others.shape), passes, axis=0)
    here, elsewhere = best[:, :1], best[:, 1:]
    rank = (here < elsewhere).mean(axis=1) + (here == elsewhere).mean(axis=1) / 2
    return frame[passes], near[passes], rank, len(frames)


def claims_cost(state: MapState, poses: np.ndarray) -> float:
    """What the views say against poses [N, 3] of the keyframes, chi-square: -2 times the log ratio of the
    density of the ranks where claims are right to that where they are wrong (uniform), for as many
    independent views as there are times `ALONE` keyframes."""
    claimant, _, rank, examined = claimed_revisits(state, poses, JUDGED)
    if not len(claimant):
        return 0.0
    right = DOUBTFUL + (1 - DOUBTFUL) * SHAPE * rank ** (SHAPE - 1)
    _, frame = np.unique(claimant, return_inverse=True)
    each = np.bincount(frame, np.log(right)) / np.bincount(frame)
    return float(-2 * each.sum() * len(poses) / (examined * ALONE))


class Obstacle(StrEnum):
    """Why a closure sequence cannot be undone, as a clause."""

    NOT_ACCEPTED = "is not an accepted closure sequence of this map"
    MERGED = "has keyframes that are merged with those that it joins them to"
    ONLY_LINK = "is the only link across a break of the odometry"


def obstacle(solution: MapState, sequence: int, log: ClosureLog) -> Obstacle | None:
    """Why a sequence cannot be undone; None if it can.

    Args:
        log: the one from which the solution was selected.
    """
    if not 0 <= sequence < log.sequences or solution.log.verdict(sequence) != Verdict.ACCEPTED:
        return Obstacle.NOT_ACCEPTED
    if log.has_merged(sequence):
        return Obstacle.MERGED
    return Obstacle.ONLY_LINK if np.any(solution.cut.rows == sequence) else None


def undo(solution: MapState, sequence: int, log: ClosureLog) -> None:
    """Removes a sequence of a log, from which the solution was selected.

    Raises:
        ValueError: it has an `Obstacle`.
    """
    against = obstacle(solution, sequence, log)
    if against is not None:
        raise ValueError(f"sequence {sequence} {against}")
    log.judge(sequence, Verdict.UNDONE)


def cheapest_map(state: MapState, priors: Sequence[CalibrationPrior]) -> MapState:
    """The map of least cost with the closures accepted so far, reached from the current poses and from dead
    reckoning with the mean of each of these calibrations. The log of `state` takes over its robust
    weights."""
    system, place = System(state.problem()), state.placement()
    starts = [state.fit(), *(_dead_reckoned(state, prior, place) for prior in priors)]
    fit = min((system.solve(start, 2 * state.config.settling) for start in starts), key=system.robust_cost)
    state.log.weigh(fit.weights)
    found = state.trial()
    found.take_fit(fit)
    return found


def selected_solution(state: MapState, hypotheses: MapHypotheses) -> MapState | None:
    """The map with the closure sequences that are best accepted together; None if none has the evidence of an
    accepted one: weak sequences count only beside it, as images without information give a few of them."""
    config, candidates = state.config, sequences_to_select(state)
    if not (candidates & (state.log.scores() >= config.min_score)).any():
        return None
    found, place, sequences = state.trial(), state.placement(), np.flatnonzero(candidates)
    cut = found.cut.rows
    judge_anew(found, sequences)
    broken = np.flatnonzero(np.isin(cut, sequences))
    earlier = tuple((frame, int(np.searchsorted(sequences, cut[frame]))) for frame in broken.tolist())
    cut[broken] = -1  # those of sequences all of whose keyframes are merged stay
    problem = selection_problem(found, sequences, place)
    # From the current map and from the hypotheses; odometry is cut only if the robot may be carried.
    starts = [found.fit(), *hypotheses.follow(problem, sequences)]
    if config.may_be_carried:
        selected = select_closures_and_cuts(problem, starts, partial(find_break, found), earlier)
    else:
        selected = select_closures(problem, starts)
        noise, start = state.heading_noise, HeadingNoise.of_start(config)
        if noise.log_factor - start.log_factor > NOISY * noise.sd:  # surely above that of the start
            reckoned = _dead_reckoned(found, problem.measurements.prior, place)
            selected = reselect(problem, selected, reckoned, noise, start)
    return selected_map(found, sequences, selected)


def solution_with(state: MapState, sequences: Sequence[Sequence[Candidate]], least: float) -> MapState | None:
    """The map with further closure sequences, from these poses; selected with all others where sequences are
    selected. None if less than a share `least` of the evidence of the further ones is accepted."""
    log, first, selected = state.log, state.log.sequences, None
    for sequence in sequences:
        log.add_accepted(sequence)
    state.optimise()
    if state.config.select_every:
        hypotheses = MapHypotheses()
        hypotheses.begin(state.fit(), log.sequences)
        selected = selected_solution(state, hypotheses)
    solution = selected or state.solved()
    new = np.arange(log.sequences) >= first
    standing = new & (solution.log.verdicts() == Verdict.ACCEPTED)
    scores = solution.log.scores()
    return solution if new.any() and scores[standing].sum() >= least * scores[new].sum() else None


def sequences_to_select(state: MapState) -> np.ndarray:
    """[R] bool, the sequences to select from."""
    config, log = state.config, state.log
    enough = (log.scores() >= config.select_score) & (log.sizes() >= config.select_length)
    possible = (log.left() > 0) & (log.verdicts() != Verdict.UNDONE)
    return enough & possible & ~spans(state.pieces(), log)


def selection_problem(state: MapState, sequences: np.ndarray, place: Place) -> SelectionProblem:
    """The problem of a selection among sequences [R], which the map then holds for accepted."""
    log = state.log
    for sequence in np.flatnonzero((log.left() > 0) & (log.verdicts() != Verdict.UNDONE)).tolist():
        log.judge(sequence, Verdict.OPEN)
    for sequence in sequences.tolist():
        log.judge(sequence, Verdict.ACCEPTED)
    problem, (first, last) = state.problem(), log.spans()[sequences].T
    evidence = np.maximum(log.scores() * log.credit(), 1.0)[sequences]
    return SelectionProblem(problem, evidence, first, last, partial(claims_cost, state), place)


def selected_map(
    state: MapState, sequences: np.ndarray, selection: Selection, recalled: int | None = None
) -> MapState:
    """The same map, which takes over a selection among sequences [R].

    Args:
        recalled: number of sequences of recall, which stay in the log if they are refused; None: all.
    """
    for sequence, weight in zip(sequences.tolist(), selection.fit.weights.tolist(), strict=True):
        state.log.judge(sequence, Verdict.ACCEPTED if weight > ACCEPTED_WEIGHT else Verdict.OPEN)
    for frame, sequence in selection.cuts:
        state.cut.rows[frame] = sequences[sequence]
    # Solved once more without the refused sequences, which removes their remaining pull.
    fit = solve(selection.fit, state.problem(), STEPS, FINE)
    state.log.weigh(fit.weights)
    state.take_fit(fit)
    if recalled is not None:
        refused = np.flatnonzero(state.log.verdicts() != Verdict.ACCEPTED)
        state.log.reject_sequences(refused[refused >= recalled])
    return state


def _dead_reckoned(state: MapState, prior: CalibrationPrior, place: Place) -> MapFit:
    """Odometry corrected by the mean of a calibration, from the first keyframe, its pieces placed."""
    poses = place(state.dead_reckoned(prior.bias, prior.turn_error))
    return MapFit(poses, prior.bias, np.zeros(0), prior.turn_error)


NOISY = 2.0
"""Standard deviations by which the learned noise has to exceed that of the start to be doubted."""
ROUNDS = 4
"""Largest number of times that a map and its noise are learned in turn."""
SETTLED = 0.05
"""Change of the log of the noise below which both are known."""


def reselect(
    case: SelectionProblem, found: Selection, reckoned: MapFit, noise: HeadingNoise, start: HeadingNoise
) -> Selection:
    """The more probable of a selection and of that from dead reckoning.

    Args:
        case: with the learned noise. found: the selection with it, without cuts. reckoned: dead reckoning.
        noise: the learned one. start: that of the first map.
    """
    factor = float(np.exp(start.log_factor - noise.log_factor))
    afresh = case._replace(measurements=case.measurements.with_heading_noise(factor))
    _, kept = _fit_noise(case, found.fit, noise, start)
    selection, other = _fit_noise(afresh, reckoned, start, start)
    return selection if other > kept else found


def _fit_noise(
    case: SelectionProblem, fit: MapFit, noise: HeadingNoise, start: HeadingNoise
) -> tuple[Selection, float]:
    """The selection from a fit, with the noise that is learned from it, and its log probability, up to a
    constant."""
    for _ in range(ROUNDS):
        selection = select_closures(case, [fit])
        fit, before = selection.fit, noise
        noise = learn_heading_noise(before, start, fit, case.measurements)
        step = noise.log_factor - before.log_factor
        case = case._replace(measurements=case.measurements.with_heading_noise(float(np.exp(step))))
        if abs(step) < SETTLED:
            break
    seen = log_posterior(noise.log_factor - start.log_factor, fit, System(case.measurements))
    refused = case.evidence[fit.weights <= ACCEPTED_WEIGHT].sum()
    return selection, seen - case.views_cost(fit.poses) / 2 - float(refused)


INTERCEPT = -0.69
WEIGHTS = np.array([-1.22, -0.03, 0.46, 0.91, 5.19])
"""Of `health_features`, in order; printed by `python -m ratslam reproduce tables health --sessions 3`."""
DOUBTED = 0.7
"""Probability above which odometry is given instead; good maps where odometry hardly drifts reach 0.6."""
EXAMINED = 300
"""Largest number of keyframes whose claims are examined."""
LEAST_CLAIMS = 0.03
"""Added to the claims that views confirm and contradict, by keyframe, so that few claims say little."""
WINDOW = 20
"""Keyframes over which the strain of the odometry is summed."""
LEAST_SCORE, LEAST_LENGTH = 2.0, 2
"""Least evidence and number of candidates of a refused sequence that counts."""
FULL_SCORE = 12.0
"""Evidence at which a refused sequence has its full weight."""
PLACE, HEADING = 2.0, 0.5
"""Deviation from a refused sequence at which half of its evidence is explained, cells and rad."""
NEUTRAL = 3.0
"""Evidence added to that of the refused sequences, half of it explained."""


def worse_than_odometry(solution: MapState) -> float:
    """Probability that the map's error is worse than odometry's; NaN without closures."""
    if not len(solution.log.accepted_rows()):
        return np.nan
    return float(expit(INTERCEPT + WEIGHTS @ health_features(solution)))


def health_features(solution: MapState) -> np.ndarray:
    """[5] the statistics of a map of at least two keyframes.

    Returns:
        0: log ratio of confirmed to contradicted claims of revisits, the map's minus odometry's. 1: the
        same log ratio of odometry. 2, strain: log10 of the largest chi-square of the odometry within
        `WINDOW` keyframes. 3: strain times the log ratio of odometry. 4: share of the evidence of refused
        sequences that the map does not explain, minus odometry's share.
    """
    reckoned = solution.dead_reckoned()
    of_map = _claims_ratio(solution, solution.pose.rows)
    of_odometry = _claims_ratio(solution, reckoned)
    sums, poses = np.cumsum(solution.fit().strain(solution.odometry())), solution.pose.rows
    window = sums[WINDOW:] - sums[:-WINDOW] if len(sums) > WINDOW else sums[-1:]
    strain = float(np.log10(max(window.max(initial=0.0), 0.0) + 1e-6))
    unexplained, before = (_unexplained(solution, each) for each in (poses, reckoned))
    return np.array([of_map - of_odometry, of_odometry, strain, strain * of_odometry, unexplained - before])


def _claims_ratio(state: MapState, poses: np.ndarray) -> float:
    """Log ratio of the claims of revisits that the views confirm to those that they contradict."""
    _, _, rank, examined = claimed_revisits(state, poses, EXAMINED)
    sides = 2 * rank - 1
    each = max(examined, 1)
    agreed, contradicted = np.maximum(sides, 0).sum() / each, np.maximum(-sides, 0).sum() / each
    return float(np.log((agreed + LEAST_CLAIMS) / (contradicted + LEAST_CLAIMS)))


def _unexplained(state: MapState, poses: np.ndarray) -> float:
    """Share of the evidence of refused sequences that poses [N, 3] do not explain."""
    log = state.log
    table = log.table()
    table = table[table[:, 5] >= 0]
    sequence = table[:, 5].astype(int)
    scores = log.scores()
    counts = (log.sizes() >= LEAST_LENGTH) & (scores >= LEAST_SCORE) & (log.verdicts() != Verdict.ACCEPTED)
    worth = np.where(counts, np.clip(scores / FULL_SCORE, 0.0, 1.0), 0.0)[sequence]
    worth = worth * np.maximum(table[:, 4], 0.0)
    j, i = table[:, :2].astype(int).T
    error = between(poses[i], poses[j])
    error[:, 2] = wrap(error[:, 2] + table[:, 2] * state.sector_angle)
    far, turned = error[:, 0] ** 2 + error[:, 1] ** 2, error[:, 2] / HEADING
    apart = far / (PLACE * state.cell) ** 2 + turned**2
    lost = (worth * apart / (1 + apart)).sum()
    return float((lost + NEUTRAL / 2) / (worth.sum() + NEUTRAL))
