"""Symmetric sparse equations over the nodes of a graph, ordered once for low fill-in."""

from __future__ import annotations

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

CG_STEPS = 6
"""Steps of conjugate gradients that cost less than a new factorization, for moderate fill-in."""


class SparseEquations:
    """The sparsity pattern of equations over nodes 0..count - 1 with edges a-b, and their factor; node 0 is
    fixed at 0.

    An edge adds to four places: (a, a), (b, b), (a, b) and (b, a), in this order.
    """

    def __init__(self, count: int, a: np.ndarray, b: np.ndarray) -> None:
        size = count - 1
        place = _elimination_order(count, a, b)
        rows = np.concatenate([place[a], place[b], place[a], place[b]])
        columns = np.concatenate([place[a], place[b], place[b], place[a]])
        self.used = (rows >= 0) & (columns >= 0)
        flat = (rows * size + columns)[self.used]
        found, slot = np.unique(np.concatenate([np.arange(size) * (size + 1), flat]), return_inverse=True)
        self.factor: SuperLU | None = None
        self.size, self.count, self.node = size, len(found), np.argsort(place)[1:]
        self.diagonal, self.slot = slot[:size][place[1:]], slot[size:]
        self.indices = (found % max(size, 1)).astype(np.int32)
        self.indptr = np.searchsorted(found, np.arange(size + 1) * size).astype(np.int32)

    def solve(
        self, entries: np.ndarray, fixed: np.ndarray, right: np.ndarray, reuse_factor: bool = False
    ) -> np.ndarray | None:
        """[count, D] the unknowns, 0 at node 0; None if the equations are singular.

        Args:
            entries: [4 E] numbers, or [3, 3, 4 E] blocks that act on the D = 3 columns of a node.
            fixed: nodes to hold at 0, one of each component that is not connected to node 0.
            right: [count, D] right-hand sides.
            reuse_factor: solve to six digits by conjugate gradients, preconditioned with the last factor,
                if that converges in `CG_STEPS`; for blocks that changed little since the last solve.
        """
        answer = np.zeros(right.shape, np.result_type(entries, right))
        if self.size == 0:
            return answer
        entries = entries[..., self.used]
        blocks = entries.shape[:-1]
        summed = np.stack([self._sum(row) for row in entries.reshape(-1, entries.shape[-1])], axis=-1)
        summed[self.diagonal[fixed - 1]] += np.eye(*blocks).ravel() if blocks else 1.0
        if blocks:
            shape = (3 * self.size, 3 * self.size)
            rows = bsr_matrix((summed.reshape(-1, 3, 3), self.indices, self.indptr), shape).tocsr()
            # The matrix is symmetric, so its rows are its columns.
            matrix = csc_matrix((rows.data, rows.indices, rows.indptr), shape)
        else:
            rows = csr_matrix((summed[:, 0], self.indices, self.indptr), (self.size, self.size))
            matrix = rows.tocsc()
        ordered = right[self.node].astype(answer.dtype).reshape(matrix.shape[0], -1)
        found = self._refine(matrix, ordered[:, 0]) if reuse_factor else None
        if found is None:
            try:
                self.factor = splu(
                    matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
                )
            except RuntimeError:  # exactly singular
                return None
            found = self.factor.solve(ordered)
        answer[self.node] = found.reshape(self.size, -1)
        return answer if np.isfinite(answer).all() else None

    def _refine(self, matrix: csc_matrix, right: np.ndarray) -> np.ndarray | None:
        if self.factor is None:
            return None
        inverse = LinearOperator(matrix.shape, self.factor.solve)
        found, unfinished = cg(matrix, right, rtol=1e-6, maxiter=CG_STEPS, M=inverse)
        return None if unfinished else found

    def _sum(self, values: np.ndarray) -> np.ndarray:
        if np.iscomplexobj(values):
            return self._sum(values.real) + 1j * self._sum(values.imag)
        return np.bincount(self.slot, values, self.count)


def component_roots(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The first node of every connected component that does not contain node 0."""
    ties = csr_matrix((np.ones(len(a), np.int8), (a, b)), (count, count))
    _, part = connected_components(ties, directed=False)
    _, first = np.unique(part, return_index=True)
    return first[first > 0]


def _elimination_order(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[count] positions of the nodes among the unknowns; -1 for node 0.

    An approximate minimum degree order, computed as SYMAMD does (Davis et al. 2004): COLAMD orders the
    columns of the graph's incidence matrix for its normal equations, which have the sparsity of ours. One
    extra row for every node and one extra column for every edge make that matrix square and triangular,
    which costs nothing to factor and changes no degree. Applied to our matrix directly, COLAMD orders for
    its square, which has more fill-in.
    """
    tied = a != b
    low, high = np.minimum(a, b)[tied] - 1, np.maximum(a, b)[tied] - 1
    size, nodes, rows = count - 1, np.arange(count - 1), count - 1 + np.arange(len(low))
    free = low >= 0
    row = np.concatenate([nodes, rows, rows[free], rows])
    column = np.concatenate([nodes, high, low[free], rows])
    # The entries of nodes are the largest in their columns, so they become the pivots.
    value = np.ones(len(row))
    value[:size] = 4.0
    if size == 0:
        return np.array([-1])
    square = csc_matrix((value, (row, column)), (size + len(rows), size + len(rows)))
    rank = splu(square, permc_spec="COLAMD").perm_c[:size]
    place = np.empty(size, np.int64)
    place[np.argsort(rank)] = nodes
    return np.concatenate([[-1], place])
