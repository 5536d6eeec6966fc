"""Symmetric sparse equations over the nodes of a graph, ordered once for factors with few entries."""

from __future__ import annotations

import numpy as np
from scipy.sparse import bsr_matrix, csc_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

TRIES = 6
"""Steps of conjugate gradients that cost less than another factor, for equations of moderate fill."""


class Pattern:
    """Where the entries stand that edges a-b add to the equations of nodes 0..count - 1; node 0 is known.

    An edge adds to four places: (a, a), (b, b), (a, b) and (b, a), in this order.
    """

    def __init__(self, count: int, a: np.ndarray, b: np.ndarray) -> None:
        size = count - 1
        place = _places(count, a, b)
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
        self, entries: np.ndarray, held: np.ndarray, right: np.ndarray, again: bool = False
    ) -> np.ndarray | None:
        """[count, D] the unknowns, 0 at node 0; None where they are not determined.

        Args:
            entries: [4 E] numbers, or [3, 3, 4 E] blocks that act on the D = 3 columns of a node.
            held: nodes that nothing ties to node 0 and that are to stay at 0.
            right: [count, D] right-hand sides.
            again: these blocks may have changed little since the last solve. Then six digits will do,
                by conjugate gradients from the last factor where they get there soon.
        """
        answer = np.zeros(right.shape, np.result_type(entries, right))
        if self.size == 0:
            return answer
        entries = entries[..., self.used]
        blocks = entries.shape[:-1]
        summed = np.stack([self._sum(row) for row in entries.reshape(-1, entries.shape[-1])], axis=-1)
        summed[self.diagonal[held - 1]] += np.eye(*blocks).ravel() if blocks else 1.0
        if blocks:
            shape = (3 * self.size, 3 * self.size)
            rows = bsr_matrix((summed.reshape(-1, 3, 3), self.indices, self.indptr), shape).tocsr()
            # The matrix is its own transpose, so its rows may be taken for columns.
            matrix = csc_matrix((rows.data, rows.indices, rows.indptr), shape)
        else:
            rows = csr_matrix((summed[:, 0], self.indices, self.indptr), (self.size, self.size))
            matrix = rows.tocsc()
        ordered = right[self.node].astype(answer.dtype).reshape(matrix.shape[0], -1)
        found = self._again(matrix, ordered[:, 0]) if again else None
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

    def _again(self, matrix: csc_matrix, right: np.ndarray) -> np.ndarray | None:
        if self.factor is None:
            return None
        nearly = LinearOperator(matrix.shape, self.factor.solve)
        found, unfinished = cg(matrix, right, rtol=1e-6, maxiter=TRIES, M=nearly)
        return None if unfinished else found

    def _sum(self, values: np.ndarray) -> np.ndarray:
        if np.iscomplexobj(values):
            return self._sum(values.real) + 1j * self._sum(values.imag)
        return np.bincount(self.slot, values, self.count)


def unreached(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The first node of every part of a graph that does not hang together with node 0."""
    ties = csr_matrix((np.ones(len(a), np.int8), (a, b)), (count, count))
    _, part = connected_components(ties, directed=False)
    _, first = np.unique(part, return_index=True)
    return first[first > 0]


def _places(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[count] where nodes stand among the unknowns; -1 for node 0.

    An approximate minimum degree order, by the trick of SYMAMD (Davis et al. 2004): COLAMD orders the columns
    of the graph's incidence matrix for its normal equations, and these have the entries of ours. One row more
    for every node and one column more for every edge make it square and triangular, which costs nothing to
    factor and changes no degree. Given our own matrix COLAMD orders for its square, and factors fill up.
    """
    tied = a != b
    low, high = np.minimum(a, b)[tied] - 1, np.maximum(a, b)[tied] - 1
    size, nodes, rows = count - 1, np.arange(count - 1), count - 1 + np.arange(len(low))
    free = low >= 0
    row = np.concatenate([nodes, rows, rows[free], rows])
    column = np.concatenate([nodes, high, low[free], rows])
    # The entries of nodes are the largest of their columns, so they are the pivots.
    value = np.ones(len(row))
    value[:size] = 4.0
    if size == 0:
        return np.array([-1])
    square = csc_matrix((value, (row, column)), (size + len(rows), size + len(rows)))
    rank = splu(square, permc_spec="COLAMD").perm_c[:size]
    place = np.empty(size, np.int64)
    place[np.argsort(rank)] = nodes
    return np.concatenate([[-1], place])
