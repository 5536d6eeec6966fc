"""The equations of a damped Gauss-Newton step: of all nodes, or of the forks between chains alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.csgraph import breadth_first_order
from scipy.sparse.linalg import splu

from ratslam.pose_graph.chains import chains
from ratslam.pose_graph.edges import Edges, diagonal
from ratslam.pose_graph.sparsity import Pattern, unreached


class Damping(NamedTuple):
    """How damping goes up when a step fails (to `first` * `factor` at least) and down when one succeeds."""

    first: float
    factor: float


class Whole:
    """The normal equations of all nodes: where every block goes is worked out once.

    Damping holds every node where it is.
    """

    damping = Damping(first=1e-6, factor=10.0)

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

    def step(self, poses, errors, information, damping) -> np.ndarray | None:
        """The damped Gauss-Newton step [N, 3], or None where the equations are singular."""
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


class Folded:
    """The normal equations of the forks: undamped, its steps are those of `Whole`.

    Seen as twists about one point of the plane, changes of poses make the error of an edge a plain
    difference: e = r + t_j - t_i, with weight W. So along a chain the r add up, and so do the covariances
    W^-1, turned to that point: the chain is one edge. What it is strained by, all its edges feel alike.

    Damping holds the edges of chains, and of a tree over the forks, at the lengths and angles they have: far
    nodes may move far as long as the map bends little anywhere, which noise in the headings asks for.
    """

    damping = Damping(first=1 / 3, factor=3.0)

    def __init__(self, count: int, edges: Edges, tamed: np.ndarray) -> None:
        determined = (diagonal(edges.information) > 0).all(axis=1)
        if edges.information.ndim == 3:  # what hardly has an inverse had better not be inverted
            alone = diagonal(edges.information).prod(axis=1)
            determined &= np.linalg.det(edges.information) > 1e-6 * alone
        self.count, self.to = count, edges.j
        self.found = found = chains(count, edges.i, edges.j, determined & ~tamed)
        self.pattern = Pattern(len(found.forks), found.a, found.b)
        self.held = unreached(len(found.forks), found.a, found.b)
        self.stiff = np.zeros(len(edges.i), bool)
        self.stiff[found.edge] = True
        self.stiff[found.loose[_tree(found.a, found.b, len(found.forks))[len(found.first) :]]] = True

    def step(self, poses, errors, information, damping) -> np.ndarray | None:
        """The damped Gauss-Newton step [N, 3], or None where the equations are singular."""
        found, (x, y) = self.found, poses.T[:2]
        weight, pull = self._weigh(errors, information, damping)

        # Chains: residuals and covariances as twists about the node at the end, added up.
        inside, end = found.edge, found.forks[found.b[found.chain]]
        to = self.to[inside]
        covariance = _inverse(weight[:, :, inside])
        residual = _times(covariance, pull[:, inside])
        residual = found.sign * _carried(residual, x[to] - x[end], y[to] - y[end])
        covariance = _carried(covariance, x[to] - x[end], y[to] - y[end])
        covariance = _carried(covariance.swapaxes(0, 1), x[to] - x[end], y[to] - y[end])
        apart, tight = found.total(residual), _inverse(found.total(covariance))

        # Forks: what is left of chains, and the loose edges.
        a, b = found.forks[found.a], found.forks[found.b]
        dx, dy = x[a] - x[b], y[a] - y[b]
        weight = np.concatenate([tight, weight[:, :, found.loose]], axis=2)
        pull = np.concatenate([_times(tight, apart), pull[:, found.loose]], axis=1)
        across = _given(weight.swapaxes(0, 1), dx, dy).swapaxes(0, 1)
        entries = np.concatenate([_given(across, dx, dy), weight, -across.swapaxes(0, 1), -across], axis=2)
        size = len(found.forks)
        right = [
            np.bincount(found.a, back, size) - np.bincount(found.b, on, size)
            for on, back in zip(pull, _given(pull, dx, dy), strict=True)
        ]
        moved = self.pattern.solve(entries, self.held, np.stack(right, axis=1), again=True)
        if moved is None:
            return None

        # Back to the inner nodes.
        change = np.zeros((3, self.count))
        change[:, found.forks] = moved.T
        chained = len(found.first)
        start = _carried(moved.T[:, found.a[:chained]], dx[:chained], dy[:chained])
        tension = _times(tight, apart + moved.T[:, found.b[:chained]] - start)
        twist = found.along(start, _times(covariance, tension[:, found.chain]) - residual)
        end = end[found.into]
        change[:, found.inner] = _carried(twist, x[end] - x[found.inner], y[end] - y[found.inner])
        return change.T if np.isfinite(change).all() else None

    def _weigh(self, errors, information, damping) -> tuple[np.ndarray, np.ndarray]:
        """Weights [3, 3, E] and their products with the residuals [3, E], by the pose of j, as damped."""
        residual, _, by_j = errors
        by_j, information = (np.ascontiguousarray(m.transpose(1, 2, 0)) for m in (by_j, information))
        back = _product(by_j.swapaxes(0, 1), information)
        # Twice as stiff and half as far off pulls as much, and gives way half as far.
        return _product(back, by_j) * np.where(self.stiff, 1 + damping, 1.0), _times(back, residual.T)


def _tree(a: np.ndarray, b: np.ndarray, count: int) -> np.ndarray:
    """[M] which edges a-b of nodes 0..count - 1 join what a tree from node 0 joins."""
    ties = csr_matrix((np.ones(len(a), np.int8), (a, b)), (count, count))
    _, parent = breadth_first_order(ties, 0, directed=False)
    return (parent[a] == b) | (parent[b] == a)


def _carried(twist: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """Movements [3, ..., E] of points, told as twists about others that lie (dx, dy) back."""
    return np.stack([twist[0] + dy * twist[2], twist[1] - dx * twist[2], twist[2]])


def _given(force: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """What pulls at twists [3, ..., E] as what pulls at the points: the transpose of `_carried`."""
    return np.stack([force[0], force[1], force[2] + dy * force[0] - dx * force[1]])


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("abe,bce->ace", a, b)


def _times(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("abe,be->ae", a, b)


def _inverse(m: np.ndarray) -> np.ndarray:
    """Inverses of symmetric positive matrices [3, 3, E], by elimination: cofactors would cancel."""
    (a, b, c), (_, d, e), (_, _, f) = m
    x, y = c / f, e / f
    a, b, d = a - x * c, b - x * e, d - y * e
    z = b / a
    yy = 1 / (d - z * b)
    xy, xx = -z * yy, 1 / a + z * z * yy
    xt, yt = -(xx * x + xy * y), -(xy * x + yy * y)
    return np.array([[xx, xy, xt], [xy, yy, yt], [xt, yt, 1 / f - x * xt - y * yt]])
