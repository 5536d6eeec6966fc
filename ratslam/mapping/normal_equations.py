"""The normal equations of the keyframes' poses and of the odometry's calibration, and their factorisation.

The matrix of the poses is symmetric positive definite, with 3 x 3 blocks for the nodes (x, y, heading) and
for the edges between them. It is factorised as L D L^T, up-looking, by blocks (Davis 2005, ACM TOMS 849); the
order of elimination (minimum degree) and the sparsity of the factor are computed once for a graph. The
calibration, one or two dense columns, is the border of the matrix and is solved for by its Schur complement.
Keyframe 0 is fixed: nodes without a number among the unknowns, position -1, add nothing to the equations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from tactile.base.compiled import compiled


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
        self._layout = _lay_out_factor(self.start, self.row)

    def factorise(self, diagonal: np.ndarray, above: np.ndarray) -> _BlockFactor | None:
        """The factor of a matrix; None if it is not positive definite.

        Args:
            diagonal: [n, 3, 3] blocks in the order of elimination. above: [B, 3, 3] blocks above it.
        """
        first, rows, *_ = layout = self._layout
        regular, blocks, inverse, logarithm = factorise(self.start, self.row, diagonal, above, layout)
        return _BlockFactor((first, rows, blocks, inverse), float(logarithm)) if regular else None


class _BlockFactor(NamedTuple):
    """The factor L D L^T of a matrix: where its blocks stand, the blocks, the inverses of D; and the natural
    logarithm of the determinant of the matrix."""

    parts: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
    log_determinant: float

    def solve(self, right: np.ndarray) -> np.ndarray:
        """[n, 3, C] the solutions for the right-hand sides [n, 3, C], in the order of elimination."""
        solution = np.array(right, np.float64, order="C")
        _solve_in_place(*self.parts, solution)
        return solution


def elimination_order(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] the position of each of n nodes with edges from a [M] to b [M]: SuperLU's minimum-degree order
    for low fill-in."""
    if not count:
        return np.zeros(0, np.int64)
    node = np.arange(count)
    ends = np.concatenate([node, a, b]), np.concatenate([node, b, a])
    matrix = csc_matrix((np.ones(len(ends[0])), ends), (count, count))
    # Only the sparsity pattern matters; the diagonal makes the matrix regular.
    matrix.data[:] = 1.0
    matrix.setdiag(4.0 * len(a) + 1)
    options = {"SymmetricMode": True}
    # One column at a time, because there is little fill-in.
    factor = splu(matrix, "MMD_AT_PLUS_A", relax=1, panel_size=1, options=options, diag_pivot_thresh=0.0)
    return factor.perm_c.astype(np.int64)


_Layout = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Where the m blocks of L stand: [n + 1] where each column begins; [m] rows of the blocks, by columns; [n +
1] where each row begins in the last two; [m] columns of each row, in an order in which they can be
eliminated; [m] place of these blocks among those by columns."""


@compiled
def _lay_out_factor(start: np.ndarray, row: np.ndarray) -> _Layout:
    """The layout of the factor of a matrix with blocks above the diagonal at `row` [B] of the columns that
    begin at `start` [n + 1]."""
    n = len(start) - 1
    parent, seen = np.full(n, -1), np.full(n, -1)  # of the elimination tree; the last row it was found in
    first, begin = np.zeros(n + 1, np.int64), np.zeros(n + 1, np.int64)
    # Row k of L: from each block of column k up the elimination tree, to where this row has been before.
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
    # The same again, writing each row from its end: the paths up the tree in an order of elimination.
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
    return first, rows, begin, columns, slots


@compiled
def _invert(a: np.ndarray, inverse: np.ndarray, k: int) -> float:
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
    start: np.ndarray, row: np.ndarray, diagonal: np.ndarray, above: np.ndarray, layout: _Layout
) -> tuple[bool, np.ndarray, np.ndarray, float]:
    """Whether the matrix is positive definite; the blocks [m, 3, 3] of L by columns; the inverse blocks
    [n, 3, 3] of D; the logarithm of the determinant."""
    n, (first, rows, begin, columns, slots) = len(diagonal), layout
    blocks, inverse = np.empty((first[n], 3, 3)), np.empty((n, 3, 3))
    column, pivot = np.zeros((n, 3, 3)), np.empty((3, 3))
    logarithm = 0.0
    for k in range(n):
        # Column k of the matrix above the diagonal, scattered; its diagonal block becomes the pivot.
        for p in range(start[k], start[k + 1]):
            i = row[p]
            for r in range(3):
                for c in range(3):
                    column[i, r, c] += above[p, r, c]
        for r in range(3):
            for c in range(3):
                pivot[r, c] = diagonal[k, r, c]
        for t in range(begin[k], begin[k + 1]):
            i, end = columns[t], slots[t]
            y00, y01, y02 = column[i, 0, 0], column[i, 0, 1], column[i, 0, 2]
            y10, y11, y12 = column[i, 1, 0], column[i, 1, 1], column[i, 1, 2]
            y20, y21, y22 = column[i, 2, 0], column[i, 2, 1], column[i, 2, 2]
            for p in range(first[i], end):  # forward substitution by column i of L
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
        determinant = _invert(pivot, inverse, k)
        if determinant == 0.0:
            return False, blocks, inverse, -np.inf
        logarithm += np.log(determinant)
    return True, blocks, inverse, logarithm


@compiled
def _solve_in_place(
    first: np.ndarray, rows: np.ndarray, blocks: np.ndarray, inverse: np.ndarray, right: np.ndarray
) -> None:
    """Replaces the right-hand sides [n, 3, C] by the solutions."""
    n, columns = len(right), right.shape[2]
    for k in range(n):  # L z = right
        for p in range(first[k], first[k + 1]):
            j = rows[p]
            for c in range(columns):
                x, y, z = right[k, 0, c], right[k, 1, c], right[k, 2, c]
                for r in range(3):
                    right[j, r, c] -= blocks[p, r, 0] * x + blocks[p, r, 1] * y + blocks[p, r, 2] * z
    for k in range(n - 1, -1, -1):  # L^T x = D^-1 z
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


PI = float(np.pi)


Measurements = tuple[np.ndarray, ...]
"""M relative poses of keyframes and what is known of them: keyframes i and j, [M] each; the measured pose
[M, 3] of j in the frame of i (m, m, rad) and the information [M, 3] of it; distance (m) and turn (rad) [M, 2]
by which heading bias and turn error bend it, 0 for closures; the positions [M] of i and of j in the order of
elimination, -1 for keyframe 0; the block [M] above the diagonal, -1 for edges of keyframe 0."""
Blocks = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""The equations of n poses and K calibration parameters: of the poses the blocks on the diagonal [n, 3, 3]
and above it [B, 3, 3]; right-hand sides [n, 3, 1 + K], the negative gradient of the poses and the border
between poses and calibration; of the calibration the matrix [K, K] and the gradient [K]."""


@compiled
def measurement_errors(
    edges: Measurements, poses: np.ndarray, bias: float, turn_error: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The measurements [M, 3] without the systematic errors of the odometry, their errors [M, 3] (m, m,
    rad), and their chi-squares [M]."""
    i, j, motion, information, regressors, _, _, _ = edges
    count = len(i)
    measured, error, chi2 = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    for m in range(count):
        a, b = i[m], j[m]
        turn = bias * regressors[m, 0] + turn_error * regressors[m, 1]
        c, s = np.cos(turn / 2), np.sin(turn / 2)
        x, y, heading = motion[m, 0], motion[m, 1], motion[m, 2]
        measured[m, 0], measured[m, 1] = c * x - s * y, s * x + c * y
        measured[m, 2] = PI - (PI - heading - turn) % (2 * PI)
        c, s = np.cos(poses[a, 2]), np.sin(poses[a, 2])
        dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        error[m, 0] = c * dx + s * dy - measured[m, 0]
        error[m, 1] = c * dy - s * dx - measured[m, 1]
        turned = poses[b, 2] - poses[a, 2] - measured[m, 2]
        error[m, 2] = PI - (PI - turned) % (2 * PI)
        total = 0.0
        for r in range(3):
            total += error[m, r] ** 2 * information[m, r]
        chi2[m] = total
    return measured, error, chi2


@compiled
def weigh_closures(
    chi2: np.ndarray, first: int, sequence: np.ndarray, scale: np.ndarray, limit: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What measurements with chi-squares [M] are trusted, the closures from number `first` on by sequence.

    Args:
        sequence: [M - first]. scale, limit: [R] of each sequence, see `LoopClosures`. The chi-square of one
            closure is limited, so that one that is wrong does not cost its whole sequence.

    Returns:
        trust [M], 1 for odometry; weight [R] and mean limited chi-square [R] of each sequence.
    """
    trust, mean, members = np.ones(len(chi2)), np.zeros(len(scale)), np.zeros(len(scale))
    for k in range(len(sequence)):
        cost, most = chi2[first + k], limit[sequence[k]]
        if most < np.inf:
            share = most / (most + cost)
            trust[first + k] = share**2
            cost *= share
        mean[sequence[k]] += cost
        members[sequence[k]] += 1
    mean /= np.maximum(members, 1)
    weight = (scale / (scale + mean)) ** 2
    for k in range(len(sequence)):
        trust[first + k] *= weight[sequence[k]]
    return trust, weight, mean


@compiled
def add_measurements(
    edges: Measurements,
    poses: np.ndarray,
    measured: np.ndarray,
    error: np.ndarray,
    trust: np.ndarray,
    blocks: Blocks,
) -> None:
    """Adds the measurements, each with its information times `trust` [M], to the equations.

    With c and s of the heading of keyframe i, the errors have the derivatives [-c -s p], [s -c q], [0 0 -1]
    by the pose of keyframe i, and [c s 0], [-s c 0], [0 0 1] by that of keyframe j. The products are
    written out, because loops over their many zeros take several times as long.
    """
    i, _, _, information, regressors, place_i, place_j, slots = edges
    diagonal, above, right, corner, slope = blocks
    for m in range(len(trust)):
        heading, at_i, at_j, slot = poses[i[m], 2], place_i[m], place_j[m], slots[m]
        c, s = np.cos(heading), np.sin(heading)
        p, q = error[m, 1] + measured[m, 1], -error[m, 0] - measured[m, 0]
        w0 = information[m, 0] * trust[m]
        w1 = information[m, 1] * trust[m]
        w2 = information[m, 2] * trust[m]
        e0, e1, e2 = w0 * error[m, 0], w1 * error[m, 1], w2 * error[m, 2]  # weighted errors
        xx, xy, yy = w0 * c * c + w1 * s * s, (w0 - w1) * c * s, w0 * s * s + w1 * c * c
        xh, yh = w1 * s * q - w0 * c * p, -w0 * s * p - w1 * c * q
        pulled_x, pulled_y = c * e0 - s * e1, s * e0 + c * e1
        if at_i >= 0:
            diagonal[at_i, 0, 0] += xx
            diagonal[at_i, 0, 1] += xy
            diagonal[at_i, 1, 0] += xy
            diagonal[at_i, 1, 1] += yy
            diagonal[at_i, 0, 2] += xh
            diagonal[at_i, 2, 0] += xh
            diagonal[at_i, 1, 2] += yh
            diagonal[at_i, 2, 1] += yh
            diagonal[at_i, 2, 2] += w0 * p * p + w1 * q * q + w2
            right[at_i, 0, 0] += pulled_x
            right[at_i, 1, 0] += pulled_y
            right[at_i, 2, 0] -= p * e0 + q * e1 - e2
        if at_j >= 0:
            diagonal[at_j, 0, 0] += xx
            diagonal[at_j, 0, 1] += xy
            diagonal[at_j, 1, 0] += xy
            diagonal[at_j, 1, 1] += yy
            diagonal[at_j, 2, 2] += w2
            right[at_j, 0, 0] -= pulled_x
            right[at_j, 1, 0] -= pulled_y
            right[at_j, 2, 0] -= e2
        if slot >= 0:
            above[slot, 0, 0] -= xx
            above[slot, 0, 1] -= xy
            above[slot, 1, 0] -= xy
            above[slot, 1, 1] -= yy
            above[slot, 2, 2] -= w2
            if at_i < at_j:  # rows of keyframe i, columns of keyframe j
                above[slot, 2, 0] -= xh
                above[slot, 2, 1] -= yh
            else:
                above[slot, 0, 2] -= xh
                above[slot, 1, 2] -= yh
        for k in range(len(slope)):  # derivative d of the errors by the calibration, at its border
            share = regressors[m, k]
            if share == 0.0:  # of closures
                continue
            d0, d1, d2 = measured[m, 1] / 2 * share, -measured[m, 0] / 2 * share, -share
            b0, b1, b2 = w0 * d0, w1 * d1, w2 * d2
            bent_x, bent_y = c * b0 - s * b1, s * b0 + c * b1
            if at_i >= 0:
                right[at_i, 0, 1 + k] -= bent_x
                right[at_i, 1, 1 + k] -= bent_y
                right[at_i, 2, 1 + k] += p * b0 + q * b1 - b2
            if at_j >= 0:
                right[at_j, 0, 1 + k] += bent_x
                right[at_j, 1, 1 + k] += bent_y
                right[at_j, 2, 1 + k] += b2
            slope[k] += d0 * e0 + d1 * e1 + d2 * e2
            for other in range(len(slope)):
                share = regressors[m, other]
                corner[k, other] += (b0 * measured[m, 1] / 2 - b1 * measured[m, 0] / 2 - b2) * share


class Equations(NamedTuple):
    """Normal equations of poses and K calibration parameters: the bias, and the turn error if it is free.

    Attributes:
        factor: of the block of the poses, None where it is singular. place: [n] position of each free
            keyframe among the unknowns. right: see `Blocks`. corner [K, K], slope [K]: matrix and gradient
            of the calibration, its prior included. weights: [R] robust weights of the closure sequences.
    """

    factor: _BlockFactor | None
    place: np.ndarray
    right: np.ndarray
    corner: np.ndarray
    slope: np.ndarray
    weights: np.ndarray

    def step(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Steps of the poses [N, 3] and of the calibration [K]."""
        if self.factor is None:
            return None
        solved = self.factor.solve(self.right)
        border = np.ascontiguousarray(self.right[:, :, 1:]).reshape(-1, len(self.slope))  # [3 n, K]
        free, bent = solved[:, :, 0].ravel(), solved[:, :, 1:].reshape(border.shape)
        change = np.linalg.solve(self.corner - border.T @ bent, -self.slope - border.T @ free)
        step = free - bent @ change
        if not np.isfinite(step).all():
            return None
        return np.concatenate([np.zeros((1, 3)), step.reshape(-1, 3)[self.place]]), change

    def log_determinant(self) -> float:
        """Of the information of all unknowns; inf where it is singular."""
        if self.factor is None:
            return float(np.inf)
        return self.factor.log_determinant + float(np.linalg.slogdet(self.bent()[1])[1])

    def bent(self) -> tuple[np.ndarray, np.ndarray]:
        """[n, 3, K] poses per calibration parameter, in the order of elimination, and [K, K] its
        information with the poses integrated out; infinite and 0 where the equations are singular."""
        border = np.ascontiguousarray(self.right[:, :, 1:])
        if self.factor is None:
            return np.full(border.shape, np.inf), np.zeros(self.corner.shape)
        bent = self.factor.solve(border)
        return bent, self.corner - np.tensordot(border, bent, axes=((0, 1), (0, 1)))
