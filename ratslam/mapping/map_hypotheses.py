"""Several maps that follow the closure sequences in the order of time.

The cost of a selection of closures has many local minima: a wrong sequence accepted early bends the map so
far that the true ones after it look wrong. So a few maps are kept side by side. Each takes every new
sequence as it fits, and once more with the sequence forced to fit, which then has to pay for itself; the
cheapest maps are kept, and beside them a few that refuse what all cheaper ones accept: weak sequences, which
can be taken or left, make many cheap maps, and these would push out the only one that a strong false sequence
has not bent. Source: a beam search over the hypotheses of multiple hypothesis tracking (Reid
1979); that its nodes are robust maps is ours."""

from __future__ import annotations

import numpy as np

from ratslam.core.checkpoint import Checkpointed
from ratslam.mapping.closure_selection import FINE, STEPS, SelectionProblem, choose_sequences
from ratslam.mapping.merging import Merge
from ratslam.mapping.optimizer import LoopClosures, MapFit, MapProblem, System
from tactile.base.se2 import integrate, wrap

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
        self._extend(case.measurements)
        known = np.isin(sequences, self._followed)
        fits = [fit._replace(poses=case.place(fit.poses)) for fit in self._fits(int(known.sum()))]
        for k in np.flatnonzero(~known).tolist():
            fits = _branch(fits, case, known, k)
            known[k] = True
        self._followed = sequences.astype(np.int64)
        self.poses = np.stack([fit.poses for fit in fits])
        self._calibration = np.array([[fit.bias, fit.turn_error] for fit in fits])
        return fits

    def merge(self, merge: Merge) -> None:
        """Follows a merge of keyframes; later ones than the maps have are kept."""
        self.poses = self.poses[:, merge.kept[merge.kept < self.poses.shape[1]]]

    def _fits(self, count: int) -> list[MapFit]:
        weights = np.ones(count)
        return [
            MapFit(poses, bias, weights, turn_error)
            for poses, (bias, turn_error) in zip(self.poses, self._calibration.tolist(), strict=True)
        ]

    def _extend(self, problem: MapProblem) -> None:
        """Continues all maps by odometry; the first one starts with the means of the calibration."""
        since = self.poses.shape[1] - 1
        if not since:
            self._calibration = np.array([[problem.prior.bias, problem.prior.turn_error]])
        onwards = [integrate(fit.corrected(problem.chain)[since:], fit.poses[-1]) for fit in self._fits(0)]
        self.poses = np.concatenate([self.poses, np.stack(onwards)], axis=1)


def _branch(fits: list[MapFit], case: SelectionProblem, known: np.ndarray, new: int) -> list[MapFit]:
    """The cheapest maps after one more sequence.

    Args:
        known: [R] bool, sequences that the maps have followed.
    """
    known = known.copy()
    known[new] = True
    problem = case.measurements
    part = problem._replace(closures=choose_sequences(problem.closures, known))
    at = int(known[:new].sum())
    system, maps = System(part), []
    forcing = system.with_problem(part._replace(closures=_force(part.closures, at)))
    for fit in fits:
        free = system.solve(fit, STEPS, FINE)
        maps.append(free)
        if free.weights[at] < FITS:
            maps.append(system.solve(forcing.solve(free, STEPS, FINE), STEPS, FINE))
    maps = [fit._replace(poses=case.place(fit.poses)) for fit in maps]
    costs = [system.robust_cost(fit) for fit in maps]
    different: list[int] = []
    for k in np.argsort(costs, kind="stable").tolist():
        if not any(_apart(maps[k], maps[other], part.closures) < ALIKE for other in different):
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


def _force(closures: LoopClosures, sequence: int) -> LoopClosures:
    """The closures, one sequence of which can hardly be refused."""
    factor = np.ones(len(closures.scale))
    factor[sequence] = FORCED
    scale = closures.scale * factor
    limit = np.maximum(closures.cost_limit, np.where(factor > 1, 1.5 * scale, 0.0))
    return closures._replace(scale=scale, cost_limit=limit)


def _apart(one: MapFit, other: MapFit, closures: LoopClosures) -> float:
    """The largest difference of a keyframe, standard deviations of a closure."""
    apart = one.poses - other.poses
    apart[:, 2] = wrap(apart[:, 2])
    return float(np.sqrt((apart**2 / closures.variance).sum(axis=1).max()))
