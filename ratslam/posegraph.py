"""SE(2) pose graphs: exact linear start, damped and robust least squares.

Node 0 is held where it is. Sources: Kuemmerle et al. 2011 (g2o: the plain error), Dellaert & Kaess 2017
(the logarithmic one), Carlone et al. 2014 (headings first, then positions).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order
from scipy.sparse.linalg import splu

from tactile.frames import wrap


class Edges(NamedTuple):
    """Relative poses measured between nodes.

    Attributes:
        i, j: [E] nodes. motion: [E, 3] pose of j in the frame of i (m, m, rad).
        information: [E, 3] inverse variances, or [E, 3, 3] inverse covariances.
    """

    i: np.ndarray
    j: np.ndarray
    motion: np.ndarray
    information: np.ndarray


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


class Kernel(NamedTuple):
    """A robust kernel over squared Mahalanobis errors: the weight of an edge and what it costs."""

    weight: Callable[[np.ndarray], np.ndarray]
    loss: Callable[[np.ndarray], np.ndarray]


no_kernel = Kernel(np.ones_like, lambda chi2: chi2)
"""Plain least squares."""


def huber(scale: float) -> Kernel:
    """Linear beyond `scale` standard deviations: a disagreeing edge pulls, but not the harder the farther."""
    return Kernel(
        lambda chi2: np.minimum(1.0, scale / np.sqrt(np.maximum(chi2, 1e-300))),
        lambda chi2: np.where(chi2 <= scale**2, chi2, 2 * scale * np.sqrt(chi2) - scale**2),
    )


def geman_mcclure(mu: float) -> Kernel:
    """Bounded: an edge that disagrees far beyond sqrt(mu) standard deviations is as good as cut."""
    return Kernel(lambda chi2: (mu / (mu + chi2)) ** 2, lambda chi2: mu * chi2 / (mu + chi2))


Error = Callable[[np.ndarray, Edges], tuple[np.ndarray, np.ndarray, np.ndarray]]


def difference_error(poses: np.ndarray, edges: Edges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The error of g2o, [E, 3]: position and heading of j in i's frame against what was measured, seen from
    the measured pose. With its Jacobians [E, 3, 3] by the poses of i and of j."""
    a, b, motion = poses[edges.i], poses[edges.j], edges.motion
    angle = a[:, 2] + motion[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    dx, dy = (b - a)[:, 0], (b - a)[:, 1]
    cm, sm = np.cos(motion[:, 2]), np.sin(motion[:, 2])
    error = np.empty((len(a), 3))
    error[:, 0] = c * dx + s * dy - cm * motion[:, 0] - sm * motion[:, 1]
    error[:, 1] = c * dy - s * dx - cm * motion[:, 1] + sm * motion[:, 0]
    error[:, 2] = wrap(b[:, 2] - a[:, 2] - motion[:, 2])
    by_a, by_b = np.zeros((2, len(a), 3, 3))
    by_b[:, 0, 0], by_b[:, 0, 1], by_b[:, 1, 0], by_b[:, 1, 1], by_b[:, 2, 2] = c, s, -s, c, 1.0
    by_a[:] = -by_b
    by_a[:, 0, 2] = c * dy - s * dx
    by_a[:, 1, 2] = -c * dx - s * dy
    return error, by_a, by_b


def logmap_error(poses: np.ndarray, edges: Edges) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The error of gtsam: the SE(2) logarithm of the plain one."""
    error, by_a, by_b = difference_error(poses, edges)
    angle, x, y = error[:, 2], error[:, 0].copy(), error[:, 1].copy()
    half = angle / 2
    small = np.abs(angle) < 1e-4
    tangent = np.tan(np.where(small, 1.0, half))
    sine = np.sin(np.where(small, 1.0, half))
    scale = np.where(small, 1 - angle**2 / 12, half / tangent)
    slope = np.where(small, -angle / 6, 0.5 / tangent - half / (2 * sine**2))
    outer = np.zeros((len(x), 3, 3))
    outer[:, 0, 0] = outer[:, 1, 1] = scale
    outer[:, 0, 1], outer[:, 1, 0] = half, -half
    outer[:, 0, 2] = slope * x + y / 2
    outer[:, 1, 2] = slope * y - x / 2
    outer[:, 2, 2] = 1.0
    log = np.stack([scale * x + half * y, scale * y - half * x, angle], axis=1)
    return log, outer @ by_a, outer @ by_b


def linear(count: int, edges: Edges, first: np.ndarray | None = None) -> np.ndarray:
    """Headings, then positions, each by one sparse linear solve: poses [count, 3], exact for small noise.

    Headings are first unrolled along a spanning tree from node 0, so drift beyond pi does not put a closure
    on the wrong branch of a turn. Nodes not tied to node 0 are put at its pose.
    """
    first = np.zeros(3) if first is None else np.asarray(first, float)
    weight = _diagonal(edges.information)
    rough = _unrolled(count, edges) + first[2]
    turns = np.round((rough[edges.j] - rough[edges.i] - edges.motion[:, 2]) / (2 * np.pi))
    turned = edges.motion[:, 2] + 2 * np.pi * turns
    heading = _laplacian(count, edges, weight[:, 2], turned[:, None], first[2:])[:, 0]
    c, s = np.cos(heading[edges.i]), np.sin(heading[edges.i])
    x, y = edges.motion[:, 0], edges.motion[:, 1]
    moved = np.stack([c * x - s * y, s * x + c * y], axis=1)
    position = _laplacian(count, edges, weight[:, :2].mean(axis=1), moved, first[:2])
    return np.column_stack([position, wrap(heading)])


def least_squares(
    poses: np.ndarray,
    edges: Edges,
    *,
    kernel: Kernel = no_kernel,
    robust: np.ndarray | None = None,
    error: Error = difference_error,
    iterations: int = 50,
    tolerance: float = 1e-9,
) -> Solution:
    """Levenberg-Marquardt from the given poses [N, 3].

    Args:
        kernel: applied to the edges of `robust` [E] bool (None: all), the others count in full.
        tolerance: the largest change of a step that ends the solve, m and rad.

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
    information = _full(edges.information)
    system = _System(len(poses), edges)
    tamed = np.ones(len(edges.i), bool) if robust is None else np.asarray(robust, bool)

    def judge(at: np.ndarray):
        residual, by_i, by_j = error(at, edges)
        with np.errstate(over="ignore", invalid="ignore"):
            chi2 = np.einsum("ea,eab,eb->e", residual, information, residual)
            weights = np.where(tamed, kernel.weight(chi2), 1.0)
            return residual, by_i, by_j, weights, float(np.where(tamed, kernel.loss(chi2), chi2).sum())

    state = judge(poses)
    if not np.isfinite(state[-1]):
        return Solution(poses, Ending.NOT_FINITE, 0, np.inf, np.ones(len(edges.i)))
    damping, taken = 1e-9, 0
    ending = Ending.ITERATIONS
    while taken < iterations:
        residual, by_i, by_j, weights, _ = state
        step = system.step(residual, by_i, by_j, weights[:, None, None] * information, damping)
        if step is None:
            ending = Ending.SINGULAR
            break
        moved = poses + step
        moved[:, 2] = wrap(moved[:, 2])
        judged = judge(moved)
        if judged[-1] <= state[-1] * (1 + 1e-12) + 1e-300:
            taken += 1
            gained = state[-1] - judged[-1]
            poses, state, damping = moved, judged, max(damping / 10, 1e-12)
            if np.abs(step).max() < tolerance or gained <= 1e-12 * state[-1]:
                ending = Ending.CONVERGED
                break
        elif np.abs(step).max() < tolerance:
            ending = Ending.CONVERGED
            break
        else:
            damping = max(damping, 1e-6) * 10
            if damping > 1e12:
                ending = Ending.STUCK
                break
    return Solution(poses, ending, taken, state[-1], state[3])


class _System:
    """The normal equations of one graph: where every block goes is worked out once."""

    def __init__(self, count: int, edges: Edges) -> None:
        self.size = 3 * (count - 1)
        ends = np.stack([edges.i, edges.j], axis=1) - 1  # node 0 is held: its rows are left out
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

    def step(self, residual, by_i, by_j, information, damping) -> np.ndarray | None:
        """The damped Gauss-Newton step [N, 3], or None where the equations are singular."""
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


def _unrolled(count: int, edges: Edges) -> np.ndarray:
    """[count] headings added up along a spanning tree from node 0, not wrapped; 0 where it does not reach."""
    ends = np.concatenate([edges.i, edges.j]), np.concatenate([edges.j, edges.i])
    turn = np.concatenate([edges.motion[:, 2], -edges.motion[:, 2]])
    key, first = np.unique(ends[0].astype(np.int64) * count + ends[1], return_index=True)
    tree = csr_matrix((np.ones(len(key)), (key // count, key % count)), (count, count))
    order, parent = breadth_first_order(tree, 0)
    heading = np.zeros(count)
    reached = order[1:]
    step = turn[first[np.searchsorted(key, parent[reached].astype(np.int64) * count + reached)]]
    for node, origin, change in zip(reached.tolist(), parent[reached].tolist(), step.tolist(), strict=True):
        heading[node] = heading[origin] + change
    return heading


def _laplacian(
    count: int, edges: Edges, weight: np.ndarray, change: np.ndarray, first: np.ndarray
) -> np.ndarray:
    """[count, D] values whose differences j - i best equal `change` [E, D], value 0 held at `first` [D]."""
    if count < 2:
        return np.tile(first, (count, 1))
    i, j = edges.i, edges.j
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    data = np.concatenate([weight, weight, -weight, -weight])
    matrix = csr_matrix((data, (rows, columns)), (count, count)).tocsc()[1:, 1:]
    loose = matrix.diagonal() == 0
    matrix = matrix + csc_matrix((np.full(count - 1, 1e-12) + loose, (range(count - 1), range(count - 1))))
    pull = weight[:, None] * change
    right = np.stack([np.bincount(j, p, count)[1:] - np.bincount(i, p, count)[1:] for p in pull.T], axis=1)
    return np.concatenate([np.zeros((1, len(first))), splu(matrix, permc_spec="COLAMD").solve(right)]) + first


def _diagonal(information: np.ndarray) -> np.ndarray:
    return information if information.ndim == 2 else np.diagonal(information, axis1=1, axis2=2)


def _full(information: np.ndarray) -> np.ndarray:
    return information if information.ndim == 3 else information[:, :, None] * np.eye(3)
