"""SE(2) least squares: damped, robust, from wherever the poses are."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from ratslam.pose_graph.edges import Edges, Error, difference_error, full
from ratslam.pose_graph.normal_equations import Folded, Whole
from ratslam.pose_graph.robust_kernels import Kernel, no_kernel
from tactile.base.se2 import wrap

FOLDED_FROM = 2000
"""Graphs of so many nodes are solved over their forks; smaller ones are done sooner than folded."""


class Ending(Enum):
    """Why a solve ended."""

    CONVERGED = "converged"
    ITERATIONS = "the iterations ran out; allow more or start nearer"
    STUCK = "no step lowers the cost; the start may be in another basin: start from `linear`"
    SINGULAR = "the equations have no unique solution; check that every node is tied to node 0"
    NOT_FINITE = "a pose, a measurement or its information is not finite"


class Solution(NamedTuple):
    """Poses [N, 3], why the solve ended, steps taken, final cost, and the robust weight [E] of each edge."""

    poses: np.ndarray
    ending: Ending
    iterations: int
    cost: float
    weights: np.ndarray


def least_squares(
    poses: np.ndarray,
    edges: Edges,
    *,
    kernel: Kernel = no_kernel,
    robust: np.ndarray | None = None,
    error: Error = difference_error,
    iterations: int = 50,
    tolerance: float = 1e-9,
    folded: bool | None = None,
) -> Solution:
    """Levenberg-Marquardt from the given poses [N, 3]; node 0 is held where it is.

    Args:
        kernel: applied to the edges of `robust` [E] bool (None: all), the others count in full.
        tolerance: the largest change of a step that ends the solve, m and rad.
        folded: whether chains of odometry are eliminated (`Folded`); None: in graphs of `FOLDED_FROM` nodes.
            Both ways end in an optimum of the same cost.

    Returns:
        from finite poses never NaN: where nothing better was found, the poses are those given.
    """
    poses = np.array(poses, float)
    if not (
        np.isfinite(poses).all() and np.isfinite(edges.motion).all() and np.isfinite(edges.information).all()
    ):
        return Solution(poses, Ending.NOT_FINITE, 0, np.inf, np.ones(len(edges.i)))
    if len(edges.i) == 0 or len(poses) < 2:
        return Solution(poses, Ending.CONVERGED, 0, 0.0, np.ones(len(edges.i)))
    information = full(edges.information)
    tamed = np.ones(len(edges.i), bool) if robust is None else np.asarray(robust, bool)
    if folded if folded is not None else len(poses) >= FOLDED_FROM:
        system: Folded | Whole = Folded(len(poses), edges, tamed & (kernel is not no_kernel))
    else:
        system = Whole(len(poses), edges)

    def judge(at: np.ndarray):
        errors = error(at, edges)
        with np.errstate(over="ignore", invalid="ignore"):
            chi2 = np.einsum("ea,eab,eb->e", errors[0], information, errors[0])
            weights = np.where(tamed, kernel.weight(chi2), 1.0)
            return errors, weights, float(np.where(tamed, kernel.loss(chi2), chi2).sum())

    state = judge(poses)
    if not np.isfinite(state[-1]):
        return Solution(poses, Ending.NOT_FINITE, 0, np.inf, np.ones(len(edges.i)))
    damping, taken = 1e-9, 0
    ending = Ending.ITERATIONS
    while taken < iterations:
        errors, weights, _ = state
        step = system.step(poses, errors, weights[:, None, None] * information, damping)
        if step is None:
            ending = Ending.SINGULAR
            break
        moved = poses + step
        moved[:, 2] = wrap(moved[:, 2])
        judged = judge(moved)
        if judged[-1] <= state[-1] * (1 + 1e-12) + 1e-300:
            taken += 1
            gained = state[-1] - judged[-1]
            poses, state, damping = moved, judged, max(damping / system.damping.factor, 1e-12)
            if np.abs(step).max() < tolerance or gained <= 1e-12 * state[-1]:
                ending = Ending.CONVERGED
                break
        elif np.abs(step).max() < tolerance:
            ending = Ending.CONVERGED
            break
        else:
            damping = max(damping, system.damping.first) * system.damping.factor
            if damping > 1e12:
                ending = Ending.STUCK
                break
    return Solution(poses, ending, taken, state[-1], state[1])
