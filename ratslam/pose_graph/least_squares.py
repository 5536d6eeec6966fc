"""Robust nonlinear least squares over SE(2) pose graphs: Levenberg-Marquardt from an initial guess."""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

import numpy as np

from ratslam.pose_graph.edges import Edges, ErrorFunction, difference_error, information_matrices
from ratslam.pose_graph.normal_equations import FullEquations, ReducedEquations
from ratslam.pose_graph.robust_kernels import Kernel, no_kernel
from tactile.base.se2 import wrap

ELIMINATE_FROM = 2000
"""Number of nodes from which chains are eliminated; smaller graphs are solved faster without."""
INITIAL_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e-12, 1e12


class Termination(Enum):
    """Reason for the end of the search."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "the iteration limit was reached; raise it or start nearer"
    NO_DECREASE = "no step lowers the cost; start from `linear_initialization`, another basin may be lower"
    SINGULAR = "the equations are singular; check that every node is connected to node 0"
    NOT_FINITE = "a pose, a measurement or its information is not finite"


class Solution(NamedTuple):
    """Poses [N, 3], reason for the end, number of steps, final cost, and robust weights [E] of the edges."""

    poses: np.ndarray
    termination: Termination
    iterations: int
    cost: float
    weights: np.ndarray


def least_squares(
    poses: np.ndarray,
    edges: Edges,
    *,
    kernel: Kernel = no_kernel,
    robust: np.ndarray | None = None,
    error: ErrorFunction = difference_error,
    iterations: int = 50,
    tolerance: float = 1e-9,
    eliminate_chains: bool | None = None,
) -> Solution:
    """Levenberg-Marquardt from the given poses [N, 3]; node 0 is fixed.

    Args:
        kernel: applied to the edges of `robust` [E] bool (None: to all); other edges have weight 1.
        tolerance: the largest change of a step at convergence, m and rad.
        eliminate_chains: solve over the junctions only (`ReducedEquations`); None: with `ELIMINATE_FROM`
            nodes or more. Both ways reach an optimum of the same cost.

    Returns:
        a solution whose poses are finite if the given poses are; without any improvement, the given poses.
    """
    poses, unit = np.array(poses, float), np.ones(len(edges.i))
    if not all(np.isfinite(values).all() for values in (poses, edges.motion, edges.information)):
        return Solution(poses, Termination.NOT_FINITE, 0, np.inf, unit)
    if len(edges.i) == 0 or len(poses) < 2:
        return Solution(poses, Termination.CONVERGED, 0, 0.0, unit)
    robust = np.ones(len(edges.i), bool) if robust is None else np.asarray(robust, bool)
    problem = _Problem(edges, information_matrices(edges.information), kernel, robust, error)
    start = problem.evaluate(poses)
    if not np.isfinite(start.cost):
        return Solution(poses, Termination.NOT_FINITE, 0, np.inf, unit)
    if len(poses) >= ELIMINATE_FROM if eliminate_chains is None else eliminate_chains:
        equations: _Equations = ReducedEquations(len(poses), edges, robust & (kernel is not no_kernel))
    else:
        equations = FullEquations(len(poses), edges)
    return _minimise(problem, equations, poses, start, iterations, tolerance)


_Equations = FullEquations | ReducedEquations


class _Evaluation(NamedTuple):
    """Errors with Jacobians, robust weights [E], and cost at some poses."""

    errors: tuple[np.ndarray, np.ndarray, np.ndarray]
    weights: np.ndarray
    cost: float


class _Problem(NamedTuple):
    """The cost to be minimised; see `least_squares`."""

    edges: Edges
    information: np.ndarray
    kernel: Kernel
    robust: np.ndarray
    error: ErrorFunction

    def evaluate(self, poses: np.ndarray) -> _Evaluation:
        errors = self.error(poses, self.edges)
        with np.errstate(over="ignore", invalid="ignore"):
            chi2 = np.einsum("ea,eab,eb->e", errors[0], self.information, errors[0])
            weights = np.where(self.robust, self.kernel.weight(chi2), 1.0)
            cost = float(np.where(self.robust, self.kernel.loss(chi2), chi2).sum())
        return _Evaluation(errors, weights, cost)


def _minimise(
    problem: _Problem,
    equations: _Equations,
    poses: np.ndarray,
    current: _Evaluation,
    iterations: int,
    tolerance: float,
) -> Solution:
    """Takes damped steps until one ends the search; damping rises after a step that raises the cost."""
    damping, taken, schedule = INITIAL_DAMPING, 0, equations.damping
    termination = Termination.ITERATION_LIMIT
    while taken < iterations:
        information = current.weights[:, None, None] * problem.information
        step = equations.step(poses, current.errors, information, damping)
        if step is None:
            termination = Termination.SINGULAR
            break
        moved = poses + step
        moved[:, 2] = wrap(moved[:, 2])
        small, trial = np.abs(step).max() < tolerance, problem.evaluate(moved)
        if trial.cost <= current.cost * (1 + 1e-12) + 1e-300:
            taken += 1
            small = small or current.cost - trial.cost <= 1e-12 * current.cost
            poses, current, damping = moved, trial, max(damping / schedule.factor, LEAST_DAMPING)
        elif not small:
            damping = max(damping, schedule.first) * schedule.factor
        if small:
            termination = Termination.CONVERGED
            break
        if damping > MOST_DAMPING:
            termination = Termination.NO_DECREASE
            break
    return Solution(poses, termination, taken, current.cost, current.weights)
