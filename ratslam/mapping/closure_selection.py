"""Selection among all closure sequences, by the cost of the map with each of them accepted or refused.

Refusing a sequence costs its evidence, accepting it costs the strain on the map. So the robust cost of a
sequence is at most twice its evidence (in chi-square), and the sequences of the map with the least total
cost are selected. Robust weights: Geman & McClure 1985. The cost has many local minima, so it is minimised
from several starts (after Latif et al. 2013): the present map, and maps that follow the sequences in the
order of time (`MapHypotheses`, a beam search as in multiple hypothesis tracking, Reid 1979). For a robot
that may be carried, the odometry is cut where that saves more than the cost of a cut.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ratslam.core.arrays import Checkpointed
from ratslam.mapping.optimizer import LoopClosures, MapFit, MapProblem, System
from ratslam.mapping.pieces import Place
from ratslam.recall.memory import MergedRows
from tactile.base.se2 import between, compose, integrate, inverse, wrap

ACCEPTED_WEIGHT = 0.25
"""Robust weight above which a sequence is accepted: its strain is then less than its evidence."""
STEPS = 12
"""Solver iterations from each start."""
FINE = 1e-3
"""Largest change per solver iteration at convergence, m and rad."""
CUT = 30.0
"""Cost of a cut of the odometry, chi-square; robots are seldom carried away."""
AGREEMENT = 3.0
"""Squared deviation up to which a sequence agrees with the odometry."""
MIN_STRAIN = 16.0
"""Least squared deviation at which a cut is tried."""
TRIALS = 5
"""Number of sequences at which a cut is tried before the best is taken."""
COST_TOLERANCE = 0.5
"""Difference in cost, chi-square, below which two cuts count as equally good."""


Cuts = tuple[tuple[int, int], ...]
"""Of the odometry: the keyframe after each cut, and the sequence that shows it."""


class SelectionProblem(NamedTuple):
    """The sequences to select from, and the odometry.

    Attributes:
        measurements: with the closures of all R sequences.
        evidence: [R] log-likelihood ratios.
        first, last: [R] first and last keyframe of each sequence.
        views_cost: what the views say against poses [N, 3], chi-square.
        place: moves pieces of the map that are joined together, see `placed_pieces`.
    """

    measurements: MapProblem
    evidence: np.ndarray
    first: np.ndarray
    last: np.ndarray
    views_cost: Callable[[np.ndarray], float]
    place: Place = np.copy

    def with_cuts(self, start: MapFit, cuts: Cuts, system: System | None = None) -> Selection:
        """The fit and its cost with these cuts, from the poses and bias of `start`; system: of the
        measurements with the cuts, where it is known."""
        system = system or System(self.measurements.cut_at([frame for frame, _ in cuts]))
        fit = system.solve(start, STEPS, FINE)
        cost = system.robust_cost(fit) + self.views_cost(fit.poses)
        return Selection(fit, cost + CUT * len(cuts), cuts)


class Selection(NamedTuple):
    """The best map found: its fit with a weight for each sequence, its cost (chi-square), and its cuts."""

    fit: MapFit
    cost: float
    cuts: Cuts


FindCut = Callable[[np.ndarray, np.ndarray, np.ndarray, int], int]
"""Finds the keyframe before which the odometry is cut. Arguments: all poses [N, 3]; poses [n, 3] by
odometry of the keyframes that follow a keyframe; the motion [3] that moves the last of them to where it was
recognised; the number of that keyframe."""


def select_closures(case: SelectionProblem, starts: Sequence[MapFit]) -> Selection:
    """The selection with the least cost, without cuts.

    Each start is optimised with all sequences at once; robust weights decide which of them count. A
    sequence is accepted in the result if its weight is above `ACCEPTED_WEIGHT`.

    Args:
        case: the sequences and the odometry.
        starts: maps to start from; the first is the current map.

    Returns:
        the cheapest of the optimised maps.
    """
    system = System(case.measurements)
    return min((case.with_cuts(start, (), system) for start in starts), key=lambda found: found.cost)


def select_closures_and_cuts(
    case: SelectionProblem, starts: Sequence[MapFit], find: FindCut, earlier: Cuts = ()
) -> Selection:
    """The selection with the least cost for a robot that may be carried: with cuts of the odometry.

    The odometry is cut where it is strained or contradicted most, one cut at a time, while that lowers the
    cost of the map by more than a cut costs (`CUT`).

    Args:
        case: the sequences and the odometry.
        starts: see `select_closures`.
        find: see `FindCut`.
        earlier: cuts (keyframe, sequence) of the current map.

    Returns:
        the selection with its cuts.
    """
    best = select_closures(case, starts)
    if earlier:
        best = min(case.with_cuts(starts[0], earlier), best, key=lambda found: found.cost)
    while True:
        strain = _strain(case, best)
        tried = np.argsort(-strain)[:TRIALS]
        strained = tried[strain[tried] >= MIN_STRAIN].tolist()
        found = [selection for sequence in strained for selection in _cut(case, best, sequence, find)]
        if not found:
            return best
        # Of equally good cuts the one that the earliest sequence shows: a cut costs the same anywhere between
        # two sequences, and views find it better where less odometry lies between.
        least, number = min(selection.cost for selection in found), len(best.cuts)
        alike = [selection for selection in found if selection.cost <= least + COST_TOLERANCE]
        cut = min(alike, key=lambda selection: case.first[selection.cuts[number][1]])
        if cut.cost >= best.cost:
            return best
        best = cut


def _strain(case: SelectionProblem, best: Selection) -> np.ndarray:
    """[R] squared deviation between the start of each sequence and the odometry since the last accepted
    closure. Both poses are those of the closures alone, so that a map deformed by a jump does not hide it."""
    chain, closures, *_ = case.measurements.cut_at([frame for frame, _ in best.cuts])
    strain = np.zeros(len(case.evidence))
    for sequence in range(len(strain)):
        since, first = _since(case, best, sequence), int(case.first[sequence])
        if first <= since:
            continue
        motion = best.fit.corrected(chain)[since:first]
        before, claimed = _claim(best, closures, since), _claim(best, closures, first, sequence)
        onwards = integrate(motion, before)
        error = between(onwards[-1], claimed)
        variance = chain.variance[since:first]
        lever = ((onwards[:, :2] - onwards[-1, :2]) ** 2).sum(axis=1) / 2
        allowed = variance.sum(axis=0) + 2 * closures.variance
        allowed[:2] += (variance[:, 2] * lever).sum()
        strain[sequence] = (error**2 / allowed).sum()
    contradicts = (best.fit.weights <= ACCEPTED_WEIGHT) & (strain > AGREEMENT)
    return np.where(contradicts, np.maximum(strain, case.evidence), strain)


def _claim(best: Selection, closures: LoopClosures, frame: int, sequence: int | None = None) -> np.ndarray:
    """[3] pose of a keyframe by its closures alone; without any, its pose in the map."""
    accepted = (best.fit.weights > ACCEPTED_WEIGHT)[closures.sequence]
    among = (closures.j == frame) & (accepted if sequence is None else closures.sequence == sequence)
    if not among.any():
        return best.fit.poses[frame]
    member = int(np.flatnonzero(among)[0])
    return compose(best.fit.poses[closures.i[member]], np.array([0.0, 0.0, closures.turn[member]]))


def _since(case: SelectionProblem, best: Selection, sequence: int) -> int:
    """The last keyframe before a sequence that an accepted sequence joins to the map."""
    earlier = (best.fit.weights > ACCEPTED_WEIGHT) & (case.last < case.first[sequence])
    return int(case.last[earlier].max(initial=0))


def _cut(case: SelectionProblem, best: Selection, sequence: int, find: FindCut) -> list[Selection]:
    """The map with a cut between a sequence and the accepted one before it; and the same with a second cut
    after the sequence, so that later accepted sequences stay in place: a robot carried twice."""
    poses = best.fit.poses
    since, first = _since(case, best, sequence), int(case.first[sequence])
    if first <= since:
        return []
    claimed = _claim(best, case.measurements.closures, first, sequence)
    frame, moved = _carry(case, best, since, first, claimed, poses, find)
    cuts = (*best.cuts, (frame, sequence))
    found = [case.with_cuts(best.fit._replace(poses=moved), cuts)]
    accepted = best.fit.weights > ACCEPTED_WEIGHT
    later = np.flatnonzero(accepted & (case.first > case.last[sequence]))
    if accepted[sequence] or not len(later):
        return found
    following = int(later[np.argmin(case.first[later])])
    end, back = int(case.last[sequence]), int(case.first[following])
    again, twice = _carry(case, best, end, back, poses[back], moved, find)
    twice[back:] = poses[back:]
    return [*found, case.with_cuts(best.fit._replace(poses=twice), (*cuts, (again, following)))]


def _carry(
    case: SelectionProblem,
    best: Selection,
    since: int,
    first: int,
    claimed: np.ndarray,
    poses: np.ndarray,
    find: FindCut,
) -> tuple[int, np.ndarray]:
    """The keyframe between `since` and `first` before which to cut so that `first` comes to the pose
    `claimed`, and the resulting poses."""
    chain = case.measurements.chain
    motion = best.fit.corrected(chain)[since:first]
    onwards = integrate(motion, poses[since])  # of frames since + 1 ... first
    carried = compose(claimed, inverse(onwards[-1]))
    frame = find(poses, onwards, carried, since)
    moved = poses.copy()
    moved[since + 1 : first + 1] = onwards
    moved[first + 1 :] = compose(compose(onwards[-1], inverse(poses[first])), poses[first + 1 :])
    moved[frame:] = compose(carried, moved[frame:])
    return frame, moved


KEPT = 4
"""Number of cheapest maps."""
DOUBTS = 3
"""Number of further maps, each of which refuses a sequence that all cheaper ones accept."""
FITS = 0.5
"""Robust weight below which a new sequence is also forced to fit."""
FORCED = 1e3
"""Factor on the robust scale of a forced sequence."""
ALIKE = 3.0
"""Standard deviations of a closure within which all keyframes of maps that count as one lie."""


class MapHypotheses(Checkpointed):
    """The maps kept, cheapest first.

    Attributes:
        poses: [K, N, 3] of K maps.
    """

    VALUES = ("poses", "_calibration", "_followed")

    def __init__(self) -> None:
        self.poses = np.zeros((1, 1, 3))
        self._calibration = np.zeros((1, 2))  # [K, 2] heading bias and turn error
        self._followed = np.zeros(0, np.int64)  # sequences

    def begin(self, fit: MapFit, sequences: int) -> None:
        """Goes back to one map, that of a fit, which has followed the first `sequences` sequences."""
        self.poses = fit.poses[None].copy()
        self._calibration = np.array([[fit.bias, fit.turn_error]])
        self._followed = np.arange(sequences)

    def follow(self, case: SelectionProblem, sequences: np.ndarray) -> list[MapFit]:
        """The maps, cheapest first, after the sequences that they have not followed yet.

        Args:
            case: with R sequences. sequences: [R] their numbers.
        """
        # All maps are continued by odometry; the first one starts with the means of the calibration.
        problem, since = case.measurements, self.poses.shape[1] - 1
        if not since:
            self._calibration = np.array([[problem.prior.bias, problem.prior.turn_error]])
        onwards = [integrate(fit.corrected(problem.chain)[since:], fit.poses[-1]) for fit in self._fits(0)]
        self.poses = np.concatenate([self.poses, np.stack(onwards)], axis=1)
        known = np.isin(sequences, self._followed)
        fits = [fit._replace(poses=case.place(fit.poses)) for fit in self._fits(int(known.sum()))]
        for k in np.flatnonzero(~known).tolist():
            fits = _branch(fits, case, known, k)
            known[k] = True
        self._followed = sequences.astype(np.int64)
        self.poses = np.stack([fit.poses for fit in fits])
        self._calibration = np.array([[fit.bias, fit.turn_error] for fit in fits])
        return fits

    def merge(self, merge: MergedRows) -> None:
        """Follows a merge of keyframes; later ones than the maps have are kept."""
        self.poses = self.poses[:, merge.source[merge.source < self.poses.shape[1]]]

    def _fits(self, count: int) -> list[MapFit]:
        weights, maps = np.ones(count), zip(self.poses, self._calibration.tolist(), strict=True)
        return [MapFit(poses, bias, weights, turn_error) for poses, (bias, turn_error) in maps]


def _branch(fits: list[MapFit], case: SelectionProblem, known: np.ndarray, new: int) -> list[MapFit]:
    """The cheapest maps after one more sequence.

    Args:
        known: [R] bool, sequences that the maps have followed.
    """
    known = known.copy()
    known[new] = True
    problem = case.measurements
    part = problem._replace(closures=problem.closures.of_sequences(known))
    at = int(known[:new].sum())
    system, maps = System(part), []
    # The same closures, of which those of the new sequence can hardly be refused.
    factor = np.ones(len(part.closures.scale))
    factor[at] = FORCED
    scale = part.closures.scale * factor
    limit = np.maximum(part.closures.cost_limit, np.where(factor > 1, 1.5 * scale, 0.0))
    forcing = system.with_problem(
        part._replace(closures=part.closures._replace(scale=scale, cost_limit=limit))
    )
    for fit in fits:
        free = system.solve(fit, STEPS, FINE)
        maps.append(free)
        if free.weights[at] < FITS:
            maps.append(system.solve(forcing.solve(free, STEPS, FINE), STEPS, FINE))
    maps = [fit._replace(poses=case.place(fit.poses)) for fit in maps]
    costs = [system.robust_cost(fit) for fit in maps]
    different: list[int] = []
    for k in np.argsort(costs, kind="stable").tolist():
        for other in different:  # the largest difference of a keyframe, standard deviations of a closure
            apart = maps[k].poses - maps[other].poses
            apart[:, 2] = wrap(apart[:, 2])
            if float(np.sqrt((apart**2 / part.closures.variance).sum(axis=1).max())) < ALIKE:
                break
        else:
            different.append(k)
    if len(different) > 1:  # the views, dearer to ask, only where there is a choice
        different.sort(key=lambda k: costs[k] + case.views_cost(maps[k].poses))
    return with_doubts([maps[k] for k in different])


def with_doubts(maps: list[MapFit]) -> list[MapFit]:
    """The `KEPT` cheapest of the maps, cheapest first, and up to `DOUBTS` that refuse what those before
    accept."""
    kept = maps[:KEPT]
    for map in maps[KEPT:]:
        shared = np.all([fit.weights >= FITS for fit in kept], axis=0)
        if len(kept) < KEPT + DOUBTS and (shared & (map.weights < FITS)).any():
            kept.append(map)
    return kept
