"""Robust nonlinear least squares over SE(2) pose graphs: Levenberg-Marquardt from an initial guess."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order
from scipy.sparse.linalg import splu

from ratslam.pose_graph.chains import find_chains
from ratslam.pose_graph.edges import (
    Edges,
    ErrorFunction,
    difference_error,
    information_diagonals,
    information_matrices,
)
from ratslam.pose_graph.sparsity import SparseEquations, component_roots
from tactile.base.se2 import wrap

ELIMINATE_FROM = 2000
"""Number of nodes from which chains are eliminated; smaller graphs are solved faster without."""
INITIAL_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e-12, 1e12


class Damping(NamedTuple):
    """Damping is multiplied by `factor`, to `first` * `factor` at least, when a step fails; divided when it
    succeeds."""

    first: float
    factor: float


class FullEquations:
    """The normal equations of all nodes; their sparsity pattern is computed once.

    Damping acts on the change of every node.
    """

    damping = Damping(first=1e-6, factor=10.0)

    def __init__(self, count: int, edges: Edges) -> None:
        self.size = 3 * (count - 1)
        ends = np.stack([edges.i, edges.j], axis=1) - 1  # node 0 is fixed: its rows are omitted
        row = (3 * ends[:, :, None] + np.arange(3)).reshape(len(ends), 6)
        free = np.repeat(ends >= 0, 3, axis=1)
        rows = np.broadcast_to(row[:, :, None], (len(row), 6, 6))
        columns = np.broadcast_to(row[:, None, :], (len(row), 6, 6))
        self.used = free[:, :, None] & free[:, None, :]
        self.row, self.free = row[free], free
        flat = columns[self.used].astype(np.int64) * self.size + rows[self.used]
        diagonal = np.arange(self.size, dtype=np.int64) * (self.size + 1)
        places, slot = np.unique(np.concatenate([flat, diagonal]), return_inverse=True)
        self.slot, self.diagonal = slot[: len(flat)], slot[len(flat) :]
        self.count = len(places)
        self.indices = (places % self.size).astype(np.int32)
        self.indptr = np.searchsorted(places // self.size, np.arange(self.size + 1)).astype(np.int32)

    def step(self, poses, errors, information, damping) -> np.ndarray | None:
        """The damped Gauss-Newton step [N, 3], or None if the equations are singular."""
        residual, by_i, by_j = errors
        jacobian = np.concatenate([by_i, by_j], axis=2)
        weighted = np.swapaxes(jacobian, 1, 2) @ information
        data = np.bincount(self.slot, (weighted @ jacobian)[self.used], self.count)
        gradient = np.bincount(self.row, (weighted @ residual[:, :, None])[..., 0][self.free], self.size)
        scale = data[self.diagonal]
        data[self.diagonal] += damping * np.where(scale > 0, scale, 1.0) + (scale == 0)
        matrix = csc_matrix((data, self.indices, self.indptr), (self.size, self.size))
        try:
            change = splu(matrix, permc_spec="COLAMD").solve(-gradient)
        except RuntimeError:
            return None
        if not np.isfinite(change).all():
            return None
        return np.concatenate([np.zeros((1, 3)), change.reshape(-1, 3)])


class ReducedEquations:
    """The normal equations of the junctions, chains eliminated; undamped steps equal `FullEquations`.

    As twists about one point of the plane, changes of poses turn the error of an edge into a difference:
    e = r + t_j - t_i, with weight W. So along a chain the residuals r add up, and so do the covariances W^-1
    transported to that point: the chain is one edge. All edges of a chain transmit the same wrench.

    Damping acts on the change in shape of the edges of chains and of a spanning tree over the junctions:
    distant nodes may move far while the map bends little anywhere, which heading noise requires.
    """

    damping = Damping(first=1 / 3, factor=3.0)

    def __init__(self, count: int, edges: Edges, robust: np.ndarray) -> None:
        determined = (information_diagonals(edges.information) > 0).all(axis=1)
        if edges.information.ndim == 3:  # nearly singular information is not inverted
            product = information_diagonals(edges.information).prod(axis=1)
            determined &= np.linalg.det(edges.information) > 1e-6 * product
        self.count, self.to = count, edges.j
        self.chains = chains = find_chains(count, edges.i, edges.j, determined & ~robust)
        size = len(chains.junctions)
        self.equations = SparseEquations(size, chains.start, chains.end)
        self.fixed = component_roots(size, chains.start, chains.end)
        self.stiff = np.zeros(len(edges.i), bool)
        self.stiff[chains.edge] = True
        # [M] bool: edges a-b of nodes 0..count - 1 that join the same nodes as an edge of a tree from node 0.
        ties = csr_matrix((np.ones(len(chains.start), np.int8), (chains.start, chains.end)), (size, size))
        _, parent = breadth_first_order(ties, 0, directed=False)
        tree = (parent[chains.start] == chains.end) | (parent[chains.end] == chains.start)
        self.stiff[chains.direct[tree[len(chains.first) :]]] = True

    def step(self, poses, errors, information, damping) -> np.ndarray | None:
        """The damped Gauss-Newton step [N, 3], or None if the equations are singular."""
        chains, (x, y) = self.chains, poses.T[:2]
        weight, wrench = self._weigh(errors, information, damping)

        # Chains: residuals and covariances as twists about the node at the end, added up.
        inside, end = chains.edge, chains.junctions[chains.end[chains.chain]]
        to = self.to[inside]
        dx, dy = x[to] - x[end], y[to] - y[end]
        covariance = _inverse(weight[:, :, inside])
        residual = chains.sign * _transport_twist(_matvec(covariance, wrench[:, inside]), dx, dy)
        covariance = _transport_twist(_transport_twist(covariance, dx, dy).swapaxes(0, 1), dx, dy)
        chain_residual, chain_weight = chains.sums(residual), _inverse(chains.sums(covariance))

        # Junctions: one edge for each chain, and the direct edges.
        a, b = chains.junctions[chains.start], chains.junctions[chains.end]
        dx, dy = x[a] - x[b], y[a] - y[b]
        weight = np.concatenate([chain_weight, weight[:, :, chains.direct]], axis=2)
        wrench = np.concatenate([_matvec(chain_weight, chain_residual), wrench[:, chains.direct]], axis=1)
        moved = self._solve_junctions(weight, wrench, dx, dy)
        if moved is None:
            return None

        # Back to the inner nodes.
        change = np.zeros((3, self.count))
        change[:, chains.junctions] = moved.T
        chained = len(chains.first)
        start = _transport_twist(moved.T[:, chains.start[:chained]], dx[:chained], dy[:chained])
        tension = _matvec(chain_weight, chain_residual + moved.T[:, chains.end[:chained]] - start)
        twist = chains.inner_values(start, _matvec(covariance, tension[:, chains.chain]) - residual)
        end = end[chains.into]
        change[:, chains.inner] = _transport_twist(twist, x[end] - x[chains.inner], y[end] - y[chains.inner])
        return change.T if np.isfinite(change).all() else None

    def _solve_junctions(
        self, weight: np.ndarray, wrench: np.ndarray, dx: np.ndarray, dy: np.ndarray
    ) -> np.ndarray | None:
        """[J, 3] changes of the junctions, from the weights [3, 3, C + L] and wrenches [3, C + L] of the
        reduced edges, whose starts lie (dx, dy) [C + L] from their ends."""
        start, end, size = self.chains.start, self.chains.end, len(self.chains.junctions)
        across = _transport_wrench(weight.swapaxes(0, 1), dx, dy).swapaxes(0, 1)
        blocks = [_transport_wrench(across, dx, dy), weight, -across.swapaxes(0, 1), -across]
        right = [
            np.bincount(start, back, size) - np.bincount(end, on, size)
            for on, back in zip(wrench, _transport_wrench(wrench, dx, dy), strict=True)
        ]
        entries = np.concatenate(blocks, axis=2)
        return self.equations.solve(entries, self.fixed, np.stack(right, axis=1), reuse_factor=True)

    def _weigh(self, errors, information, damping) -> tuple[np.ndarray, np.ndarray]:
        """Damped weights [3, 3, E] and wrenches [3, E] (weight times residual), by the pose of j."""
        residual, _, by_j = errors
        by_j, information = (np.ascontiguousarray(m.transpose(1, 2, 0)) for m in (by_j, information))
        back = _matmul(by_j.swapaxes(0, 1), information)
        # With twice the stiffness and half the residual the wrench is equal and the change half as large.
        return _matmul(back, by_j) * np.where(self.stiff, 1 + damping, 1.0), _matvec(back, residual.T)


def _transport_twist(twist: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """Twists [3, ..., E] about points (dx, dy) away, from twists about the original points."""
    return np.stack([twist[0] + dy * twist[2], twist[1] - dx * twist[2], twist[2]])


def _transport_wrench(force: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """Wrenches [3, ..., E] transported to points (dx, dy) away: the transpose of `_transport_twist`."""
    return np.stack([force[0], force[1], force[2] + dy * force[0] - dx * force[1]])


def _matmul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("abe,bce->ace", a, b)


def _matvec(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("abe,be->ae", a, b)


def _inverse(m: np.ndarray) -> np.ndarray:
    """Inverses of symmetric positive matrices [3, 3, E], by elimination; cofactors would lose digits."""
    (a, b, c), (_, d, e), (_, _, f) = m
    x, y = c / f, e / f
    a, b, d = a - x * c, b - x * e, d - y * e
    z = b / a
    yy = 1 / (d - z * b)
    xy, xx = -z * yy, 1 / a + z * z * yy
    xt, yt = -(xx * x + xy * y), -(xy * x + yy * y)
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, 1 / f - x * xt - y * yt]])


class Kernel(NamedTuple):
    """A robust kernel: weight and cost of an edge as functions of its squared Mahalanobis error."""

    weight: Callable[[np.ndarray], np.ndarray]
    loss: Callable[[np.ndarray], np.ndarray]


no_kernel = Kernel(np.ones_like, lambda chi2: chi2)
"""Plain least squares."""


def huber(scale: float) -> Kernel:
    """Cost linear beyond `scale` standard deviations, so the influence of an edge is bounded (Huber 1964)."""
    return Kernel(
        lambda chi2: np.minimum(1.0, scale / np.sqrt(np.maximum(chi2, 1e-300))),
        lambda chi2: np.where(chi2 <= scale**2, chi2, 2 * scale * np.sqrt(chi2) - scale**2),
    )


def geman_mcclure(mu: float) -> Kernel:
    """Cost bounded by mu: an error far beyond sqrt(mu) standard deviations has no influence (Geman 1985)."""
    return Kernel(lambda chi2: (mu / (mu + chi2)) ** 2, lambda chi2: mu * chi2 / (mu + chi2))


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
