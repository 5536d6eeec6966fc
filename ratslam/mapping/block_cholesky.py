"""Symmetric positive definite equations over nodes with three unknowns each, factorised by blocks.

The order of elimination and the sparsity of the factor are computed once for a graph and used for all
matrices on it.

Compiled loops of the sparse factorisation L D L^T of a symmetric matrix of 3 x 3 blocks.

The matrix is given by its diagonal blocks [n, 3, 3] and the blocks above the diagonal, by columns: block p
with start[k] <= p < start[k + 1] stands at (row[p], k). Source: the up-looking LDL^T of Davis 2005 (ACM TOMS
849), with blocks in the place of numbers.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from ratslam.core.compiled import compiled


class BlockPattern:
    """The sparsity pattern of a matrix with a block for each of n nodes and each edge between two of them.

    Args:
        count: n. a, b: [M] nodes of each edge; an edge may occur several times. place: [n] position of each
            node in the order of elimination; None: an order of low fill-in is computed.

    Attributes:
        place: [n] position of each node in the order of elimination. slot: [M] the block above the diagonal
            that each edge adds to. start [n + 1], row [B]: these blocks by columns, see
            `factorise`.
    """

    def __init__(self, count: int, a: np.ndarray, b: np.ndarray, place: np.ndarray | None = None) -> None:
        self.count = count
        self.place = elimination_order(count, a, b) if place is None else place
        ends = np.sort(np.stack([self.place[a], self.place[b]], axis=1), axis=1)
        keys, self.slot = np.unique(ends[:, 1] * count + ends[:, 0], return_inverse=True)
        self.row = keys % max(count, 1)
        self.start = np.searchsorted(keys, np.arange(count + 1) * count)
        self._layout = lay_out_factor(self.start, self.row)

    def factorise(self, diagonal: np.ndarray, above: np.ndarray) -> BlockFactor | None:
        """The factor of a matrix; None if it is not positive definite.

        Args:
            diagonal: [n, 3, 3] blocks in the order of elimination. above: [B, 3, 3] blocks above it.
        """
        layout = self._layout
        regular, blocks, inverse, logarithm = factorise(self.start, self.row, diagonal, above, layout)
        return BlockFactor(layout.first, layout.rows, blocks, inverse, float(logarithm)) if regular else None


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


def elimination_order(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] the position of each of n nodes with edges from a [M] to b [M]: SuperLU's minimum-degree order for
    low fill-in."""
    if not count:
        return np.zeros(0, np.int64)
    start, row = neighbours(count, a, b)
    column = np.repeat(np.arange(count), np.diff(start))
    # Only the sparsity pattern matters; the diagonal makes the matrix regular.
    values = np.where(row == column, 4.0 * len(a) + 1, 1.0)
    matrix = csc_matrix((values, row, start), (count, count))
    options = {"SymmetricMode": True}
    # One column at a time, because there is little fill-in.
    factor = splu(matrix, "MMD_AT_PLUS_A", relax=1, panel_size=1, options=options, diag_pivot_thresh=0.0)
    return factor.perm_c.astype(np.int64)


@compiled
def neighbours(count: int, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the column of each of n nodes begins [n + 1], and the rows of the columns, ascending: the node
    itself and those that an edge from a [M] to b [M] joins it to."""
    start = np.zeros(count + 1, np.int32)
    for m in range(len(a)):
        start[a[m] + 1] += 1
        start[b[m] + 1] += 1
    for k in range(count):
        start[k + 1] += start[k] + 1
    rows, end = np.empty(start[count], np.int32), start[:count].copy()
    for k in range(count):
        insert(rows, start[k], end, k, k)
    for m in range(len(a)):
        insert(rows, start[a[m]], end, a[m], b[m])
        insert(rows, start[b[m]], end, b[m], a[m])
    kept = 0
    for k in range(count):
        first, start[k] = start[k], kept
        for p in range(first, end[k]):
            rows[kept] = rows[p]
            kept += 1
    start[count] = kept
    return start, rows[:kept]


@compiled
def insert(rows: np.ndarray, first: int, end: np.ndarray, column: int, row: int) -> None:
    """Puts a row into its place among the ascending `rows` of a column, which begin at `first` and end before
    end[column], unless it is there."""
    p = end[column]
    while p > first and rows[p - 1] > row:
        p -= 1
    if p > first and rows[p - 1] == row:
        return
    for q in range(end[column], p, -1):
        rows[q] = rows[q - 1]
    rows[p] = row
    end[column] += 1


class FactorLayout(NamedTuple):
    """Where the m blocks of L stand.

    Attributes:
        first: [n + 1] where each column begins. rows: [m] of the blocks, by columns. begin: [n + 1] where
            each row begins in `columns` and `slots`. columns: [m] of each row, in an order in which they can
            be eliminated. slots: [m] place of these blocks among those by columns.
    """

    first: np.ndarray
    rows: np.ndarray
    begin: np.ndarray
    columns: np.ndarray
    slots: np.ndarray


@compiled
def lay_out_factor(start: np.ndarray, row: np.ndarray) -> FactorLayout:
    """The layout of the factor of a matrix with blocks above the diagonal at `row` [B] of the columns that
    begin at `start` [n + 1]."""
    n = len(start) - 1
    parent, seen = np.full(n, -1), np.full(n, -1)  # of the elimination tree; the last row it was found in
    first, begin = np.zeros(n + 1, np.int64), np.zeros(n + 1, np.int64)
    for k in range(n):
        seen[k] = k
        for p in range(start[k], start[k + 1]):
            i = row[p]
            while seen[i] != k:
                if parent[i] == -1:
                    parent[i] = k
                first[i + 1] += 1
                begin[k + 1] += 1
                seen[i] = k
                i = parent[i]
    first, begin = np.cumsum(first), np.cumsum(begin)
    rows, columns, slots = np.empty((3, first[n]), np.int64)
    filled, path = first[:n].copy(), np.empty(n, np.int64)
    seen[:] = -1
    for k in range(n):
        seen[k] = k
        top = begin[k + 1]
        for p in range(start[k], start[k + 1]):
            i, length = row[p], 0
            while seen[i] != k:
                path[length] = i
                length += 1
                seen[i] = k
                i = parent[i]
            while length > 0:
                length -= 1
                top -= 1
                columns[top] = path[length]
        for t in range(top, begin[k + 1]):
            i = columns[t]
            slots[t] = filled[i]
            rows[filled[i]] = k
            filled[i] += 1
    return FactorLayout(first, rows, begin, columns, slots)


@compiled
def invert(a: np.ndarray, inverse: np.ndarray, k: int) -> float:
    """inverse[k] = the inverse of the symmetric a [3, 3]; returns its determinant, or 0 if it is not
    positive."""
    m00 = a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1]
    m01 = a[0, 2] * a[2, 1] - a[0, 1] * a[2, 2]
    m02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    m11 = a[0, 0] * a[2, 2] - a[0, 2] * a[2, 0]
    m12 = a[0, 2] * a[1, 0] - a[0, 0] * a[1, 2]
    m22 = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    determinant = a[0, 0] * m00 + a[1, 0] * m01 + a[2, 0] * m02
    if not (a[0, 0] > 0 and m22 > 0 and determinant > 0):
        return 0.0
    inverse[k, 0, 0] = m00 / determinant
    inverse[k, 1, 1] = m11 / determinant
    inverse[k, 2, 2] = m22 / determinant
    inverse[k, 0, 1] = inverse[k, 1, 0] = m01 / determinant
    inverse[k, 0, 2] = inverse[k, 2, 0] = m02 / determinant
    inverse[k, 1, 2] = inverse[k, 2, 1] = m12 / determinant
    return determinant


@compiled
def factorise(
    start: np.ndarray, row: np.ndarray, diagonal: np.ndarray, above: np.ndarray, layout: FactorLayout
) -> tuple[bool, np.ndarray, np.ndarray, float]:
    """Whether the matrix is positive definite; the blocks [m, 3, 3] of L by columns; the inverse blocks
    [n, 3, 3] of D; the logarithm of the determinant."""
    n, first, rows = len(diagonal), layout.first, layout.rows
    blocks, inverse = np.empty((first[n], 3, 3)), np.empty((n, 3, 3))
    column, pivot = np.zeros((n, 3, 3)), np.empty((3, 3))
    logarithm = 0.0
    for k in range(n):
        for p in range(start[k], start[k + 1]):
            i = row[p]
            for r in range(3):
                for c in range(3):
                    column[i, r, c] += above[p, r, c]
        for r in range(3):
            for c in range(3):
                pivot[r, c] = diagonal[k, r, c]
        for t in range(layout.begin[k], layout.begin[k + 1]):
            i, end = layout.columns[t], layout.slots[t]
            y00, y01, y02 = column[i, 0, 0], column[i, 0, 1], column[i, 0, 2]
            y10, y11, y12 = column[i, 1, 0], column[i, 1, 1], column[i, 1, 2]
            y20, y21, y22 = column[i, 2, 0], column[i, 2, 1], column[i, 2, 2]
            for p in range(first[i], end):
                j = rows[p]
                for r in range(3):
                    b0, b1, b2 = blocks[p, r, 0], blocks[p, r, 1], blocks[p, r, 2]
                    column[j, r, 0] -= b0 * y00 + b1 * y10 + b2 * y20
                    column[j, r, 1] -= b0 * y01 + b1 * y11 + b2 * y21
                    column[j, r, 2] -= b0 * y02 + b1 * y12 + b2 * y22
            for r in range(3):  # the block (k, i) of L is y^T D^-1
                x0, x1, x2 = column[i, 0, r], column[i, 1, r], column[i, 2, r]
                b0 = x0 * inverse[i, 0, 0] + x1 * inverse[i, 1, 0] + x2 * inverse[i, 2, 0]
                b1 = x0 * inverse[i, 0, 1] + x1 * inverse[i, 1, 1] + x2 * inverse[i, 2, 1]
                b2 = x0 * inverse[i, 0, 2] + x1 * inverse[i, 1, 2] + x2 * inverse[i, 2, 2]
                blocks[end, r, 0], blocks[end, r, 1], blocks[end, r, 2] = b0, b1, b2
                pivot[r, 0] -= b0 * y00 + b1 * y10 + b2 * y20
                pivot[r, 1] -= b0 * y01 + b1 * y11 + b2 * y21
                pivot[r, 2] -= b0 * y02 + b1 * y12 + b2 * y22
            for r in range(3):
                for c in range(3):
                    column[i, r, c] = 0.0
        determinant = invert(pivot, inverse, k)
        if determinant == 0.0:
            return False, blocks, inverse, -np.inf
        logarithm += np.log(determinant)
    return True, blocks, inverse, logarithm


@compiled
def solve_in_place(
    first: np.ndarray, rows: np.ndarray, blocks: np.ndarray, inverse: np.ndarray, right: np.ndarray
) -> None:
    """Replaces the right-hand sides [n, 3, C] by the solutions."""
    n, columns = len(right), right.shape[2]
    for k in range(n):
        for p in range(first[k], first[k + 1]):
            j = rows[p]
            for c in range(columns):
                x, y, z = right[k, 0, c], right[k, 1, c], right[k, 2, c]
                for r in range(3):
                    right[j, r, c] -= blocks[p, r, 0] * x + blocks[p, r, 1] * y + blocks[p, r, 2] * z
    for k in range(n - 1, -1, -1):
        for c in range(columns):
            x, y, z = right[k, 0, c], right[k, 1, c], right[k, 2, c]
            for r in range(3):
                right[k, r, c] = inverse[k, r, 0] * x + inverse[k, r, 1] * y + inverse[k, r, 2] * z
        for p in range(first[k], first[k + 1]):
            j = rows[p]
            for c in range(columns):
                x, y, z = right[j, 0, c], right[j, 1, c], right[j, 2, c]
                for r in range(3):
                    right[k, r, c] -= blocks[p, 0, r] * x + blocks[p, 1, r] * y + blocks[p, 2, r] * z
