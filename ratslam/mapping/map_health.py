"""Health of a map: the probability that its error is worse than odometry's, told without truth.

Map and odometry are compared as predictors of revisits (`claimed_revisits`) and of the closure sequences that
the map refused; a map that bends odometry is suspect where odometry itself foretells revisits well. A
logistic regression on these statistics was fitted to maps with known error (`python -m ratslam reproduce
tables health`). The statistics are ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import expit

from ratslam.mapping.claimed_revisits import claimed_revisits
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import ClosureLog, Verdict
from ratslam.mapping.map_solution import MapSolution
from tactile.base.se2 import between, wrap

INTERCEPT = -0.69
WEIGHTS = np.array([-1.22, -0.03, 0.46, 0.91, 5.19])
"""Of `HealthFeatures`, in order; printed by `python -m ratslam reproduce tables health --sessions 3`."""
DOUBTED = 0.7
"""Probability above which odometry is given instead; good maps where odometry hardly drifts reach 0.6."""
EXAMINED = 300
"""Largest number of keyframes whose claims are examined."""
LEAST_CLAIMS = 0.03
"""Added to the claims borne out and contradicted by each keyframe, so that few claims say little."""
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


class HealthFeatures(NamedTuple):
    """Statistics of a map.

    Attributes:
        gain: log ratio of borne-out to contradicted claims of revisits, the map's minus odometry's. odometry:
            the same log ratio of odometry. strain: log10 of the largest chi-square of the odometry within
            `WINDOW` keyframes. contested: strain times that log ratio of odometry. unexplained: share of the
            evidence of refused sequences that the map does not explain, minus odometry's share.
    """

    gain: float
    odometry: float
    strain: float
    contested: float
    unexplained: float


def worse_than_odometry(graph: KeyframeGraph, solution: MapSolution) -> float:
    """Probability that the map's error is worse than odometry's; NaN without closures."""
    if not len(solution.log.accepted_rows()):
        return np.nan
    return float(expit(INTERCEPT + WEIGHTS @ np.array(health_features(graph, solution))))


def health_features(graph: KeyframeGraph, solution: MapSolution) -> HealthFeatures:
    """The statistics of a map; of at least two keyframes."""
    reckoned = graph.dead_reckoned()
    of_map = _claims_ratio(graph, solution.fit.poses)
    of_odometry = _claims_ratio(graph, reckoned)
    strain, angle = _strain(graph, solution), graph.sector_angle
    unexplained, before = (
        _unexplained(solution.log, poses, angle, graph.cell) for poses in (solution.fit.poses, reckoned)
    )
    return HealthFeatures(
        of_map - of_odometry, of_odometry, strain, strain * of_odometry, unexplained - before
    )


def _claims_ratio(graph: KeyframeGraph, poses: np.ndarray) -> float:
    """Log ratio of the claims of revisits that the views bear out to those that they contradict."""
    claims = claimed_revisits(graph, poses, EXAMINED)
    sides = 2 * claims.likeness - 1
    each = max(claims.examined, 1)
    agreed, contradicted = np.maximum(sides, 0).sum() / each, np.maximum(-sides, 0).sum() / each
    return float(np.log((agreed + LEAST_CLAIMS) / (contradicted + LEAST_CLAIMS)))


def _strain(graph: KeyframeGraph, solution: MapSolution) -> float:
    chain, poses = graph.odometry(solution.cut), solution.fit.poses
    measured = solution.fit.corrected(chain)
    error = between(poses[:-1], poses[1:]) - measured
    error[:, 2] = wrap(error[:, 2])
    sums = np.cumsum((error**2 / chain.variance).sum(axis=1))
    window = sums[WINDOW:] - sums[:-WINDOW] if len(sums) > WINDOW else sums[-1:]
    return float(np.log10(max(window.max(initial=0.0), 0.0) + 1e-6))


def _unexplained(log: ClosureLog, poses: np.ndarray, angle: float, cell: float) -> float:
    """Share of the evidence of refused sequences that poses [N, 3] do not explain."""
    table = log.table()
    table = table[table[:, 5] >= 0]
    sequence = table[:, 5].astype(int)
    scores = log.scores()
    counts = (log.sizes() >= LEAST_LENGTH) & (scores >= LEAST_SCORE) & (log.verdicts() != Verdict.ACCEPTED)
    worth = np.where(counts, np.clip(scores / FULL_SCORE, 0.0, 1.0), 0.0)[sequence]
    worth = worth * np.maximum(table[:, 4], 0.0)
    j, i = table[:, :2].astype(int).T
    error = between(poses[i], poses[j])
    error[:, 2] = wrap(error[:, 2] + table[:, 2] * angle)
    apart = (error[:, 0] ** 2 + error[:, 1] ** 2) / (PLACE * cell) ** 2 + (error[:, 2] / HEADING) ** 2
    lost = (worth * apart / (1 + apart)).sum()
    return float((lost + NEUTRAL / 2) / (worth.sum() + NEUTRAL))
