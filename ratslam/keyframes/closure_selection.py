"""Which runs of closures to believe: all are weighed against each other and against the odometry.

A run that is wrong costs its evidence, one that is right costs the strain it puts on the map; so the robust
cost of a run can never exceed twice its evidence (in chi-square), and what is believed is the set that leaves
the least cost in all. The cost has many valleys: it is descended from several starts. What no single map
can explain, a robot that was carried away may: odometry is cut where that saves more than a cut costs. The
rules are ours; robust weights by Geman & McClure 1985, several starts after Latif et al. 2013.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ratslam.keyframes.optimizer import Chain, Closures, Fit, Prior, robust_cost, solve
from tactile.base.se2 import between, compose, correct_heading_bias, integrate, inverse

KEPT = 0.25
"""Robust weight above which a run is believed: it then strains the map by less than its evidence."""
STRONG = (20.0, 40.0)
"""Evidence of the runs that the further starts are made from."""
STEPS = 12
"""Solver steps from each start."""
FINE = 1e-3
"""m and rad that a solver step moves at most when a map counts as settled."""
CUT = 30.0
"""What cutting the odometry costs, in chi-square: robots are seldom carried away."""
PLAUSIBLE = 3.0
"""Squared deviation up to which odometry does not contradict a run."""
TELLING = 16.0
"""Squared deviation from which a cut is tried."""
TRIES = 5
"""Places where a cut is tried before the best of them is taken."""
ALIKE = 0.5
"""Difference in cost, in chi-square, that tells nothing of where a cut belongs."""
LOOSE = 1e4
"""Standard deviation of a cut, m and rad."""


class Case(NamedTuple):
    """What is to be judged.

    Attributes:
        chain, closures, prior: see `solve`; closures of all runs in question, R of them. evidence: [R].
        first, last: [R] first and last frame of each run.
    """

    chain: Chain
    closures: Closures
    prior: Prior
    evidence: np.ndarray
    first: np.ndarray
    last: np.ndarray


class Judgement(NamedTuple):
    """The best map found: its fit with a weight for each run, its cost, and (frame, run) of each cut before a
    frame, with the run that tells of it."""

    fit: Fit
    cost: float
    cuts: tuple[tuple[int, int], ...]


Where = Callable[[np.ndarray, np.ndarray, np.ndarray, int], int]
"""Finds the frame before which the odometry is cut: given all poses [N, 3], those [n, 3] that odometry alone
tells for the frames after a frame, the motion [3] that carries the last of them where it belongs, and that
frame."""


def select_closures(
    case: Case, starts: Sequence[Fit], where: Where, earlier: tuple[tuple[int, int], ...] = ()
) -> Judgement:
    """The judgement with the least cost.

    Args:
        starts: maps to begin from; the first is the present one, the last odometry's own. where: see `Where`.
        earlier: cuts (frame, run) of the present map.
    """
    best = _settled(case, starts[0], earlier)
    if earlier:  # they may serve no purpose any more
        best = min(best, _settled(case, starts[0], ()), key=_cost)
    if not (best.fit.weights > KEPT).all():
        best = min([best, *_anew(case, starts)], key=_cost)
    return _with_cuts(case, best, where)


def _anew(case: Case, starts: Sequence[Fit]) -> list[Judgement]:
    """Maps without cuts from all starts, and from those that only strong runs make of the last one."""
    begin, path = list(starts), starts[-1]
    for least in STRONG:
        strong = case.evidence >= least
        if strong.any() and not strong.all():
            alone = _only(case.closures, strong)
            begin.append(solve(path.poses, path.bias, case.chain, alone, case.prior, STEPS, FINE))
    return [_settled(case, start, ()) for start in begin]


def _cost(judgement: Judgement) -> float:
    return judgement.cost


def _with_cuts(case: Case, best: Judgement, where: Where) -> Judgement:
    """Cuts the odometry where it is strained or contradicted most, as long as that pays."""
    while True:
        strain = _strain(case, best)
        tempting = [run for run in np.argsort(-strain)[:TRIES].tolist() if strain[run] >= TELLING]
        found = [judgement for run in tempting for judgement in _cut(case, best, run, where)]
        cut = _nearest(case, best, found) if found else best
        if cut.cost >= best.cost:
            return best
        best = cut


def _nearest(case: Case, best: Judgement, found: list[Judgement]) -> Judgement:
    """The cheapest; of those that cost the same, that told of by the run that begins first: between two runs
    a cut costs the same wherever it is, and the less odometry lies between, the surer views tell where."""
    least = min(judgement.cost for judgement in found)
    alike = [judgement for judgement in found if judgement.cost <= least + ALIKE]
    return min(alike, key=lambda judgement: case.first[judgement.cuts[len(best.cuts)][1]])


def _strain(case: Case, best: Judgement) -> np.ndarray:
    """[R] squared deviation of where each run begins from where odometry leads since the last closure that is
    believed, both by what they claim alone: a map that has bent to a jump does not hide it."""
    chain, closures = _severed(case.chain, best.cuts), case.closures
    strain = np.zeros(len(case.evidence))
    for run in range(len(strain)):
        since, first = _since(case, best, run), int(case.first[run])
        if first <= since:
            continue
        told = correct_heading_bias(chain.motion[since:first], chain.length[since:first], best.fit.bias)
        before, claimed = _claim(best, closures, since), _claim(best, closures, first, run)
        onwards = integrate(told, before)
        error = between(onwards[-1], claimed)
        variance = chain.variance[since:first]
        lever = ((onwards[:, :2] - onwards[-1, :2]) ** 2).sum(axis=1) / 2
        allowed = variance.sum(axis=0) + 2 * closures.variance
        allowed[:2] += (variance[:, 2] * lever).sum()
        strain[run] = (error**2 / allowed).sum()
    contradicts = (best.fit.weights <= KEPT) & (strain > PLAUSIBLE)
    return np.where(contradicts, np.maximum(strain, case.evidence), strain)


def _claim(best: Judgement, closures: Closures, frame: int, run: int | None = None) -> np.ndarray:
    """[3] where closures alone put a frame; where none speaks of it, where the map has it."""
    among = closures.j == frame
    among &= (closures.run == run) if run is not None else (best.fit.weights > KEPT)[closures.run]
    if not among.any():
        return best.fit.poses[frame]
    member = int(np.flatnonzero(among)[0])
    return compose(best.fit.poses[closures.i[member]], np.array([0.0, 0.0, closures.turn[member]]))


def _since(case: Case, best: Judgement, run: int) -> int:
    """The last frame before a run that a believed run ties to the map."""
    earlier = (best.fit.weights > KEPT) & (case.last < case.first[run])
    return int(case.last[earlier].max(initial=0))


def _cut(case: Case, best: Judgement, run: int, where: Where) -> list[Judgement]:
    """The map with the odometry cut somewhere between a run and what is believed before it; and the same with
    what is believed after it left where it is, by a second cut: a robot carried twice."""
    poses = best.fit.poses
    since, first = _since(case, best, run), int(case.first[run])
    if first <= since:
        return []
    claimed = _claim(best, case.closures, first, run)
    frame, moved = _carried(case, best, since, first, claimed, poses, where)
    cuts = (*best.cuts, (frame, run))
    found = [_settled(case, best.fit._replace(poses=moved), cuts)]
    believed = best.fit.weights > KEPT
    later = np.flatnonzero(believed & (case.first > case.last[run]))
    if believed[run] or not len(later):
        return found
    following = int(later[np.argmin(case.first[later])])
    end, back = int(case.last[run]), int(case.first[following])
    again, twice = _carried(case, best, end, back, poses[back], moved, where)
    twice[back:] = poses[back:]
    return [*found, _settled(case, best.fit._replace(poses=twice), (*cuts, (again, following)))]


def _carried(
    case: Case,
    best: Judgement,
    since: int,
    first: int,
    claimed: np.ndarray,
    poses: np.ndarray,
    where: Where,
) -> tuple[int, np.ndarray]:
    """The frame between `since` and `first` before which to cut so that `first` comes to where it is claimed,
    and the poses that follow from that."""
    chain = case.chain
    told = correct_heading_bias(chain.motion[since:first], chain.length[since:first], best.fit.bias)
    onwards = integrate(told, poses[since])  # of frames since + 1 ... first
    carried = compose(claimed, inverse(onwards[-1]))
    frame = where(poses, onwards, carried, since)
    moved = poses.copy()
    moved[since + 1 : first + 1] = onwards
    moved[first + 1 :] = compose(compose(onwards[-1], inverse(poses[first])), poses[first + 1 :])
    moved[frame:] = compose(carried, moved[frame:])
    return frame, moved


def _severed(chain: Chain, cuts: tuple[tuple[int, int], ...]) -> Chain:
    if not cuts:
        return chain
    variance = chain.variance.copy()
    variance[[frame - 1 for frame, _ in cuts]] = LOOSE**2
    return chain._replace(variance=variance)


def _settled(case: Case, start: Fit, cuts: tuple[tuple[int, int], ...]) -> Judgement:
    chain = _severed(case.chain, cuts)
    fit = solve(start.poses, start.bias, chain, case.closures, case.prior, STEPS, FINE)
    cost = robust_cost(fit, chain, case.closures, case.prior) + CUT * len(cuts)
    return Judgement(fit, cost, cuts)


def _only(closures: Closures, runs: np.ndarray) -> Closures:
    """The closures of some runs [R] bool."""
    rows = runs[closures.run]
    number = np.cumsum(runs) - 1
    return closures._replace(
        i=closures.i[rows],
        j=closures.j[rows],
        turn=closures.turn[rows],
        run=number[closures.run[rows]],
        scale=closures.scale[runs],
        stray=np.broadcast_to(closures.stray, closures.scale.shape)[runs],
    )
