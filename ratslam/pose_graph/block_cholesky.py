"""Symmetric positive definite equations over nodes with three unknowns each, factorised by blocks.

The order of elimination and the sparsity of the factor are computed once for a graph and used for all
matrices on it.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from ratslam.pose_graph.block_kernels import count_factor, factorise, solve_in_place


class BlockPattern:
    """The sparsity pattern of a matrix with a block for each of n nodes and each edge between two of them.

    Args:
        count: n. a, b: [M] nodes of each edge; an edge may occur several times.

    Attributes:
        place: [n] position of each node in the order of elimination. slot: [M] the block above the diagonal
            that each edge adds to. start [n + 1], row [B]: these blocks by columns, see
            `ratslam.pose_graph.block_kernels`.
    """

    def __init__(self, count: int, a: np.ndarray, b: np.ndarray) -> None:
        self.count = count
        self.place = _elimination_order(count, a, b)
        ends = np.sort(np.stack([self.place[a], self.place[b]], axis=1), axis=1)
        keys, self.slot = np.unique(ends[:, 1] * count + ends[:, 0], return_inverse=True)
        self.row = keys % max(count, 1)
        self.start = np.searchsorted(keys, np.arange(count + 1) * count)
        self._parent, self._first = count_factor(self.start, self.row)

    def factorise(self, diagonal: np.ndarray, above: np.ndarray) -> BlockFactor | None:
        """The factor of a matrix; None if it is not positive definite.

        Args:
            diagonal: [n, 3, 3] blocks in the order of elimination. above: [B, 3, 3] blocks above it.
        """
        regular, rows, blocks, inverse, logarithm = factorise(
            self.start, self.row, diagonal, above, self._parent, self._first
        )
        return BlockFactor(self._first, rows, blocks, inverse, float(logarithm)) if regular else None


class BlockFactor:
    """The factor L D L^T of a matrix.

    Attributes:
        log_determinant: natural logarithm of the determinant of the matrix.
    """

    def __init__(
        self,
        first: np.ndarray,
        rows: np.ndarray,
        blocks: np.ndarray,
        inverse: np.ndarray,
        log_determinant: float,
    ) -> None:
        self._parts = first, rows, blocks, inverse
        self.log_determinant = log_determinant

    def solve(self, right: np.ndarray) -> np.ndarray:
        """[n, 3, C] the solutions for the right-hand sides [n, 3, C], in the order of elimination."""
        solution = np.array(right, np.float64, order="C")
        solve_in_place(*self._parts, solution)
        return solution


def _elimination_order(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] the position of each node: SuperLU's minimum-degree order for low fill-in."""
    if not count:
        return np.zeros(0, np.int64)
    ones, nodes = np.ones(len(a)), np.arange(count)
    # Only the sparsity pattern matters; the diagonal makes the matrix regular.
    edges = csc_matrix((ones, (a, b)), (count, count))
    degree = csc_matrix((np.full(count, 4.0 * len(a) + 1), (nodes, nodes)), (count, count))
    options = {"SymmetricMode": True}
    factor = splu(edges + edges.T + degree, "MMD_AT_PLUS_A", options=options, diag_pivot_thresh=0.0)
    return factor.perm_c.astype(np.int64)
