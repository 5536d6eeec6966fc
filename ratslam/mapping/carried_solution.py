"""The final map of a robot that may be carried: the odometry cut where all views together show it.

During a session a cut is found from one closure sequence at a time, up to a lap off, or not at all. So the
final map is retraced: its own stretches, the places that sequences claim and places that look alike are
followed as tracks, and the likeliest sequence of tracks is that of a hidden Markov model in which the robot
is seldom carried (Viterbi 1967). Odometry is cut where it jumps, the sequences are selected anew, and so on
in turn. Each time the robot is retraced once on all keyframes and once on earlier ones alone, because two
segments placed wrongly together support each other. Each map is first aligned by closures along its own
poses: without realignment a correct map scores below a wrong one. The most likely map is given.
"""

from __future__ import annotations

from operator import itemgetter
from typing import NamedTuple

import numpy as np

from ratslam.mapping.closure_selection import CUT, MapHypotheses, Selection, SelectionProblem
from ratslam.mapping.ground import (
    EVEN,
    LEAVING,
    REACH,
    REACH_HEADING,
    GainOdds,
    Ground,
    compare_view,
    follow_track,
    learn_gain_odds,
    move_pose,
)
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.map_solution import selected_map, selection_problem, sequences_to_select
from ratslam.mapping.map_state import MapState
from ratslam.mapping.optimizer import MapFit, MapProblem, System
from ratslam.mapping.verification import turn_on_spot
from tactile.base.compiled import compiled, wrapped
from tactile.base.se2 import inverse

ROUNDS = 3
"""Number of times that the robot is retraced."""
ALIGNED = 3
"""Number of times that a map is aligned by the views along its poses; more change it little."""
MOST_RETRACED = 2000
"""Largest number of keyframes of a map that is retraced: each is compared with every other."""
FEWEST_RETRACED = 100
"""Least number of them: fewer teach nothing about how views fit."""


class _CarriedProblem(NamedTuple):
    """What is selected from once the odometry is cut.

    Attributes:
        state: without cuts and without the candidates that lie across one. sequences: [R] those to select
            from. problem: among these. breaks: of each cut its keyframe, and the first of the sequences after
            it, the last one if there is none.
    """

    state: MapState
    sequences: np.ndarray
    problem: SelectionProblem
    breaks: tuple[tuple[int, int], ...]

    @property
    def cuts(self) -> np.ndarray:
        """[n] keyframes before which the odometry is cut."""
        return np.array([frame for frame, _ in self.breaks], int)

    def starts(self, fit: MapFit) -> list[MapFit]:
        """Maps to start from: a fit, and those that follow the sequences in order of time."""
        cut = self.problem._replace(measurements=self._measurements())
        return [fit, *MapHypotheses().follow(cut, self.sequences)]

    def cost(self, fit: MapFit) -> float:
        """Chi-square of a fit, its cuts left out."""
        return System(self._measurements()).robust_cost(fit) + self.problem.views_cost(fit.poses)

    def _measurements(self) -> MapProblem:
        return self.problem.measurements.cut_at(self.cuts)


_ScoredMap = tuple[float, Selection, _CarriedProblem, _CarriedProblem]
"""The log-likelihood of a selection with what all views say, nat; the selection; what it is among: the
sequences of recall and those along the poses; and the sequences of recall alone."""


def is_retraced(state: MapState) -> bool:
    """Whether the final map of these keyframes, none of them merged, is retraced: not if pieces are given."""
    config = state.config
    known = FEWEST_RETRACED <= state.count <= MOST_RETRACED and not state.begins.rows.any()
    return bool(config.may_be_carried and config.select_every and known)


def retraced_solution(solution: MapState) -> MapState:
    """The map of a solution, no keyframe of it merged, after the robot has been retraced; the same if it has
    no sequences."""
    fits, fit, log = view_fits(solution), solution.fit(), solution.log
    odds = learn_odds(SelfTraverse.of_map(solution, fit, fits))
    first = _carried_problem(solution, log, np.flatnonzero(solution.cut.rows >= 0))
    if not len(first.sequences):
        return solution
    newest = best = _score(fits, odds, first, [fit])
    later = np.triu(np.ones((len(fits), len(fits)), bool))
    past = np.where(later[:, None], np.float32(-np.inf), fits)  # those at earlier keyframes
    for _ in range(ROUNDS):
        found = [_retrace(fits, compared, odds, newest, log) for compared in (fits, past)]
        newest = max(found, key=itemgetter(0))
        best = max(best, newest, key=itemgetter(0))
    _, selection, case, _ = best
    return selected_map(case.state, case.sequences, selection, recalled=log.sequences)


def kept_part(solution: MapState, kept: MapState) -> MapState:
    """A solution of all keyframes reduced to the keyframes of the map `kept`, and, if these are fewer, to its
    sequences."""
    rows = kept.taken.rows
    if len(rows) == solution.count:
        return solution
    found = kept.trial()
    found.log.follow(solution.log)
    found.cut.replace(solution.cut.rows[rows])
    found.log.reject_across(np.flatnonzero(found.cut.rows >= 0))
    found.take_fit(solution.fit()._replace(poses=solution.pose.rows[rows]))
    return found


def _carried_problem(state: MapState, log: ClosureLog, cuts: np.ndarray) -> _CarriedProblem:
    """The selection with the odometry cut before keyframes `cuts` [n], ascending, and the closures of a
    log."""
    state = state.trial()
    state.log = log.copy()
    state.log.reject_across(cuts)
    state.cut.rows[:] = -1
    sequences = np.flatnonzero(sequences_to_select(state))
    problem = selection_problem(state, sequences, np.copy)
    shows = np.array([np.append(np.flatnonzero(problem.first >= frame), -1)[0] for frame in cuts], int)
    return _CarriedProblem(state, sequences, problem, tuple(zip(cuts.tolist(), shows.tolist(), strict=True)))


def _retrace(
    fits: np.ndarray,
    compared: np.ndarray,
    odds: GainOdds,
    before: _ScoredMap,
    log: ClosureLog,
) -> _ScoredMap:
    """The map after the robot has been retraced once, by the fits `compared` [N, S, N]."""
    _, (fit, *_), _, case = before
    state = case.state
    session = SelfTraverse.of_map(state, fit, fits)
    compared_there = session._replace(fits=compared)
    poses, _, cuts = retrace(compared_there, learn_odds(session), case.cuts, log, state.sector_angle)
    case = _carried_problem(state, log, cuts)
    return _score(fits, odds, case, case.starts(fit._replace(poses=poses)))


def _score(fits: np.ndarray, odds: GainOdds, case: _CarriedProblem, starts: list[MapFit]) -> _ScoredMap:
    """The most likely of the selections from these starts, aligned by the views.

    Args:
        fits: [N, S, N], see `view_fits`. odds: the same for all maps that are compared.
    """
    selections = [case.problem.with_cuts(start, case.breaks) for start in starts]
    likelihoods = [_likelihood(fits, odds, case, one.fit) for one in selections]
    selection, aligned = selections[int(np.argmax(likelihoods))], case
    for _ in range(ALIGNED):
        # Among the sequences of the case and those along the poses of the fit.
        log, session = case.state.log.copy(), SelfTraverse.of_map(case.state, selection.fit, fits)
        add_closures_along(log, session, case.cuts, case.state.config.max_gap)
        aligned = _carried_problem(case.state, log, case.cuts)
        selection = aligned.problem.with_cuts(selection.fit, aligned.breaks)
    return _likelihood(fits, odds, case, selection.fit), selection, aligned, case


def _likelihood(fits: np.ndarray, odds: GainOdds, case: _CarriedProblem, fit: MapFit) -> float:
    """Of all views, the cuts, the odometry and the sequences of recall; those along the poses would count
    the views twice."""
    seen = SelfTraverse.of_map(case.state, fit, fits).own_odds(odds).sum()
    return float(seen) - JUMP * len(case.breaks) - case.cost(fit) / 2


LONGEST = 10
"""Largest number of closures of one sequence, which is accepted or refused as a whole."""


def add_closures_along(log: ClosureLog, session: SelfTraverse, cuts: np.ndarray, max_gap: int) -> None:
    """Adds to the log the earlier keyframe that fits best at the pose of each keyframe, where any fits
    better than a new place.

    Args:
        cuts: keyframes [n], ascending, before which the odometry is cut; no sequence lies across one.
            max_gap: largest number of keyframes between two closures of a sequence.
    """
    part = np.searchsorted(cuts, np.arange(session.size), side="right")
    before, length = -1, 0
    for frame, pose in enumerate(session.poses):
        earlier = session.ground._replace(poses=session.poses[:frame])
        best = earlier.best_match(pose, session.fits[frame])
        if best is None:
            continue
        near = before >= 0 and frame - before <= max_gap and part[frame] == part[before]
        follows = bool(near and length < LONGEST)
        posterior = float(1 / (1 + np.exp(-best.gain)))
        log.add(Candidate(frame, best.frame, best.shift, posterior, best.gain), follows)
        before, length = frame, length + 1 if follows else 1


SAMPLES = 60
"""Number of stretches by which the odds of false poses are learned."""
FIRST, FURTHER = 8, 16
"""Keyframes by which alike places are chosen, and those after them whose fits there count."""
ALIKE = 4
"""Number of alike places for each stretch."""
ELSEWHERE = 2.0
"""Least distance of another place, as a multiple of the reach of a keyframe."""


def view_fits(state: MapState) -> np.ndarray:
    """[N, S, N] float32 log-odds that the view of a keyframe (first axis) is one of the place of another
    (last axis), facing alike and, with whiskers, opposite; -inf for those of nearly the same time."""
    count, shifts = state.count, 1 + state.half_turns
    fits = np.empty((count, shifts, count), np.float32)
    every, reversed = np.tile(np.arange(count), shifts), np.repeat(np.arange(shifts) > 0, count)
    for frame in range(count):
        fits[frame] = state.log_odds(frame, every, reversed).reshape(shifts, count)
        fits[frame, :, max(frame - state.guard, 0) : frame + state.guard + 1] = -np.inf
    return fits


def learn_odds(session: SelfTraverse) -> GainOdds:
    """The log-odds of a fit, from those at the map's own poses and on tracks from other places that look
    alike."""
    true, false = session.own_fits(), [np.zeros(0)]
    places = session.places()
    frames = np.arange(FIRST, session.size - FIRST - FURTHER, max(session.size // SAMPLES, 1))
    for frame in frames.tolist():
        fits = session.scan(frame, places, FIRST)
        apart = np.hypot(*(places - session.poses[frame])[:, :2].T)
        facing = np.cos(places[:, 2] - session.poses[frame, 2]) > np.cos(2 * session.ground.reach_heading)
        fits[(apart < ELSEWHERE * session.ground.reach) & facing] = -np.inf
        for place in np.argsort(-fits, kind="stable")[:ALIKE].tolist():
            *_, found, _ = session.follow(frame, places[place], frame + FIRST + FURTHER, EVEN)
            false.append(found[FIRST:])
    other = np.concatenate(false)
    return learn_gain_odds(true[np.isfinite(true)], other[np.isfinite(other)])


JUMP = CUT
"""Penalty of one relocation, nat: twice what a cut costs a selection, because each view counts here, and
successive ones are alike."""
BEYOND, AROUND = 60, 180
"""Keyframes over which a stretch of the map is followed beyond its ends, and over which any other track is
followed."""
LOOKED, EVERY = 8, 4
"""Keyframes whose views together show whether the map fits, and how often that is asked."""
POOR_FIT = 0.5
"""Mean log-odds of these below which other places are tried, nat."""
TRIED = 4
"""Number of such places."""


def retrace(
    session: SelfTraverse, odds: GainOdds, cuts: np.ndarray, log: ClosureLog, sector_angle: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """The most likely track through all keyframes.

    Args:
        cuts: keyframes [n] before which the odometry of the map is cut. log: whose sequences claim places.

    Returns:
        poses [N, 3] of the keyframes; the log-odds of their views there less `JUMP` for each cut; the
        keyframes [n] before which odometry is cut.
    """
    # The stretches of the map between its cuts, followed on beyond them.
    own, tracks = session.own_odds(odds), []
    for first, last in zip([0, *cuts.tolist()], [*cuts.tolist(), session.size], strict=True):
        tracks.append(session.track(first, session.poses[first:last], own[first:last], BEYOND, odds))
    # Where the sequences claim the keyframe of their middle members to be.
    for sequence in np.flatnonzero((log.left() > 1) & (log.verdicts() != Verdict.UNDONE)).tolist():
        members = log.members(sequence)
        frame, match, shift, _ = members[len(members) // 2].tolist()
        _add(tracks, session, odds, frame, turn_on_spot(session.poses[match], -shift * sector_angle))
    # Places that look alike where the poses of the map do not fit.
    fits, places = np.convolve(own, np.ones(LOOKED), "valid"), session.places()
    for frame in range(0, len(fits), EVERY):
        if fits[frame] < POOR_FIT * LOOKED:
            alike = session.scan(frame, places, LOOKED)
            for place in np.argsort(-alike, kind="stable")[:TRIED].tolist():
                _add(tracks, session, odds, frame, places[place])
    poses, gained = (np.stack(part) for part in zip(*tracks, strict=True))
    reach = session.ground.reach, session.ground.reach_heading
    chosen, jumps, total = _best_sequence(poses, gained, *reach, JUMP)
    return poses[chosen, np.arange(session.size)], total, np.flatnonzero(jumps)


def _add(tracks: list[Track], session: SelfTraverse, odds: GainOdds, frame: int, pose: np.ndarray) -> None:
    """Adds the track of a keyframe at a pose [3], unless one leads past it."""
    reach, facing = session.ground.reach, np.cos(session.ground.reach_heading)
    for poses, _ in tracks:
        x, y, turn = poses[frame] - pose
        if np.hypot(x, y) < reach and np.cos(turn) > facing:
            return
    tracks.append(session.track_from(frame, pose, AROUND, odds))


@compiled
def _best_sequence(
    poses: np.ndarray, odds: np.ndarray, reach: float, reach_heading: float, jump: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """The sequence of tracks with the largest log-odds.

    Args:
        poses: [K, N, 3] of K tracks. odds: [K, N], -inf where a track does not lead. reach, reach_heading:
            differences below which two tracks are at one pose, m and rad. jump: cost of a change between
            tracks that are not.

    Returns:
        the track of each keyframe [N]; bool [N], whether it was reached by a jump; the log-odds.
    """
    tracks, count = odds.shape
    score = odds[:, 0].copy()
    before, jumped = np.zeros((count, tracks), np.int64), np.zeros((count, tracks), np.bool_)
    for k in range(1, count):  # Viterbi: the best way to each track t at keyframe k
        best, after = int(np.argmax(score)), np.full(tracks, -np.inf)
        for t in range(tracks):
            if odds[t, k] == -np.inf:
                continue
            value, source, leaps = score[best] - jump, best, True
            for u in range(tracks):  # without a jump from tracks that are at the same pose
                if score[u] <= value or odds[t, k - 1] == -np.inf:
                    continue
                x, y = poses[t, k - 1, 0] - poses[u, k - 1, 0], poses[t, k - 1, 1] - poses[u, k - 1, 1]
                alike = np.cos(poses[t, k - 1, 2] - poses[u, k - 1, 2]) > np.cos(reach_heading)
                if u == t or (x * x + y * y < reach * reach and alike):
                    value, source, leaps = score[u], u, False
            before[k, t], jumped[k, t], after[t] = source, leaps, value + odds[t, k]
        score = after
    chosen, jumps = np.empty(count, np.int64), np.zeros(count, np.bool_)
    chosen[-1] = np.argmax(score)  # and back along the best sources
    for k in range(count - 1, 0, -1):
        chosen[k - 1] = before[k, chosen[k]]
        jumps[k] = jumped[k, chosen[k]]
    return chosen, jumps, score[chosen[-1]]


LOST = -25.0
"""Log-odds of the newest views below which a track ends."""
CLIPPED = 20.0
"""Largest absolute log-odds of one view when many poses are compared at once, nat."""


Track = tuple[np.ndarray, np.ndarray]
"""Poses [N, 3], and log-odds [N] of each keyframe: NaN and -inf where the track does not lead."""


class SelfTraverse(NamedTuple):
    """A session of N keyframes over its own map: they are ground and session.

    Attributes:
        ground: at their poses. fits: [N, S, N], see `view_fits`. motions, variances: [N - 1, 3] of the
            odometry, without its systematic errors and without breaks.
    """

    ground: Ground
    fits: np.ndarray
    motions: np.ndarray
    variances: np.ndarray

    @classmethod
    def of_map(cls, state: MapState, fit: MapFit, fits: np.ndarray) -> SelfTraverse:
        """The keyframes of a map at the poses of a fit."""
        motions = fit.corrected(state.odometry())
        variances = state.odometry_variance(state.length.rows, state.turn.rows)[1:]
        turns, reach = np.arange(fits.shape[1]) * np.pi, REACH * state.cell
        ground = Ground(fit.poses, turns, reach, REACH_HEADING, state.closure_variance())
        return cls(ground, fits, motions, variances)

    @property
    def poses(self) -> np.ndarray:
        """[N, 3] m, m, rad."""
        return self.ground.poses

    @property
    def size(self) -> int:
        """N."""
        return len(self.poses)

    def own_fits(self) -> np.ndarray:
        """[N] how well each view fits at the keyframe's own pose, NaN where no keyframe is near."""
        return np.array([self._fit(frame, pose) for frame, pose in enumerate(self.poses)])

    def _fit(self, frame: int, pose: np.ndarray) -> float:
        """How well the view of a keyframe fits at a pose [3], NaN where no keyframe is near."""
        on = self.ground
        return compare_view(on.poses, on.turns, self.fits[frame], pose, on.reach, on.reach_heading)[0]

    def own_odds(self, odds: GainOdds) -> np.ndarray:
        """[N] the log-odds of each view at the keyframe's own pose."""
        fits = self.own_fits()
        off = np.isnan(fits)
        left = off & ~np.concatenate([[True], off[:-1]])
        seen = odds.odds[np.searchsorted(odds.edges, np.where(off, 0.0, fits))]
        return np.where(off, np.where(left, LEAVING, 0.0), seen)

    def follow(self, frame: int, pose: np.ndarray, stop: int, odds: GainOdds) -> tuple[np.ndarray, ...]:
        """Follows a pose [3] of a keyframe until keyframe `stop`, or until it is lost.

        Returns:
            keyframes [n], poses [n, 3], fits [n] and log-odds [n] of those that come after `frame`.
        """
        stop = min(max(stop, 0), self.size - 1)
        ahead = stop >= frame
        frames = np.arange(frame + 1, stop + 1) if ahead else np.arange(frame - 1, stop - 1, -1)
        motions = self.motions[frames - 1] if ahead else inverse(self.motions[frames])
        variances = self.variances[frames - 1] if ahead else self.variances[frames]
        on = self.ground
        _, *found = follow_track(
            on.poses, on.turns, self.fits, frames, motions, variances, on.variance, on.reach,
            on.reach_heading, odds.edges, odds.odds, LOST, pose,
        )  # fmt: skip
        return frames[: len(found[0])], *found

    def track(self, first: int, poses: np.ndarray, gained: np.ndarray, extent: int, odds: GainOdds) -> Track:
        """The track through the keyframes from number `first` on at `poses` [n, 3], where they have these
        log-odds [n], and at most `extent` keyframes after and before them."""
        every, of_each = track = np.full((self.size, 3), np.nan), np.full(self.size, -np.inf)
        last = first + len(poses) - 1
        every[first : last + 1], of_each[first : last + 1] = poses, gained
        for end, stop in ((last, last + extent), (first, first - extent)):
            frames, onwards, _, more = self.follow(end, every[end].copy(), stop, odds)
            every[frames], of_each[frames] = onwards, more
        return track

    def track_from(self, frame: int, pose: np.ndarray, extent: int, odds: GainOdds) -> Track:
        """The track through a keyframe at a pose [3]."""
        fit = self._fit(frame, pose)
        gained = LEAVING if np.isnan(fit) else odds.of(fit)
        return self.track(frame, pose[None], np.array([gained]), extent, odds)

    def places(self) -> np.ndarray:
        """[C, 3] poses that a robot may have on the ground, one of each that can be told apart."""
        on = self.ground
        return _spread_out(on.poses, on.turns, on.reach, on.reach_heading)

    def scan(self, frame: int, places: np.ndarray, length: int) -> np.ndarray:
        """[C] how well the views of a keyframe and those after it, `length` together, fit if the keyframe
        is at each of the places [C, 3]."""
        on, last = self.ground, min(frame + length, self.size)
        reach = on.reach, on.reach_heading
        return _scan(on.poses, on.turns, self.fits, self.motions, places, frame, last, *reach)


@compiled
def _scan(
    ground: np.ndarray, turns: np.ndarray, fits: np.ndarray, motions: np.ndarray, places: np.ndarray,
    first: int, last: int, reach: float, reach_heading: float,
) -> np.ndarray:  # fmt: skip
    """See `SelfTraverse.scan`."""
    total = np.zeros(len(places))
    for k in range(len(places)):
        pose = places[k].copy()
        for frame in range(first, last):
            fit = compare_view(ground, turns, fits[frame], pose, reach, reach_heading)[0]
            total[k] += -1.0 if np.isnan(fit) else min(max(fit, -CLIPPED), CLIPPED)
            if frame + 1 < last:
                move_pose(pose, motions[frame])
    return total


@compiled
def _spread_out(poses: np.ndarray, turns: np.ndarray, reach: float, reach_heading: float) -> np.ndarray:
    """See `SelfTraverse.places`."""
    kept = np.empty((len(turns) * len(poses), 3))
    count = 0
    for s in range(len(turns)):
        for i in range(len(poses)):
            angle = wrapped(poses[i, 2] + turns[s])
            known = False
            for k in range(count):
                x, y = kept[k, 0] - poses[i, 0], kept[k, 1] - poses[i, 1]
                near = x * x + y * y < reach * reach / 2
                known = known or (near and abs(wrapped(kept[k, 2] - angle)) < reach_heading)
            if not known:
                kept[count, 0], kept[count, 1], kept[count, 2] = poses[i, 0], poses[i, 1], angle
                count += 1
    return kept[:count].copy()
