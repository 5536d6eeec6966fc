"""The normal equations of the keyframes' poses, which stand in blocks, and of the odometry's calibration.

Keyframe 0 is fixed. Keyframes without a number among the unknowns, position -1, add nothing to the equations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.core.compiled import compiled
from ratslam.pose_graph.block_cholesky import BlockFactor, BlockPattern

PI = float(np.pi)


class Measurements(NamedTuple):
    """M relative poses of keyframes and what is known of them.

    Attributes:
        i, j: [M] keyframes. information: [M, 3] of keyframe j in the frame of keyframe i. regressors: [M, K]
            distance (m) and turn (rad) by which the K calibration parameters turn each measurement.
        at_i, at_j: [M] position of the keyframes in the order of elimination, -1 for keyframe 0.
        slot: [M] block above the diagonal, -1 for edges of keyframe 0.
    """

    i: np.ndarray
    j: np.ndarray
    information: np.ndarray
    regressors: np.ndarray
    at_i: np.ndarray
    at_j: np.ndarray
    slot: np.ndarray


class Blocks(NamedTuple):
    """The equations of n poses and K calibration parameters.

    Attributes:
        diagonal [n, 3, 3], above [B, 3, 3]: of the poses. right: [n, 3, 1 + K] negative gradient of the
            poses, and the border between poses and calibration. corner [K, K], slope [K]: of the calibration.
    """

    diagonal: np.ndarray
    above: np.ndarray
    right: np.ndarray
    corner: np.ndarray
    slope: np.ndarray


@compiled
def measurement_errors(
    poses: np.ndarray, i: np.ndarray, j: np.ndarray, measured: np.ndarray, information: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors [M, 3] (m, m, rad) of measured relative poses [M, 3], and their chi-squares [M]."""
    error, chi2 = np.empty((len(i), 3)), np.empty(len(i))
    for m in range(len(i)):
        a, b = i[m], j[m]
        c, s = np.cos(poses[a, 2]), np.sin(poses[a, 2])
        dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        error[m, 0] = c * dx + s * dy - measured[m, 0]
        error[m, 1] = c * dy - s * dx - measured[m, 1]
        turn = poses[b, 2] - poses[a, 2] - measured[m, 2]
        error[m, 2] = PI - (PI - turn) % (2 * PI)
        total = 0.0
        for r in range(3):
            total += error[m, r] ** 2 * information[m, r]
        chi2[m] = total
    return error, chi2


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
    by the pose of keyframe i, and [c s 0], [-s c 0], [0 0 1] by that of keyframe j. The products are written
    out, because loops over their many zeros take several times as long.
    """
    diagonal, above, right, corner, slope = blocks
    parameters = edges.regressors.shape[1]
    for m in range(len(trust)):
        heading, at_i, at_j, slot = poses[edges.i[m], 2], edges.at_i[m], edges.at_j[m], edges.slot[m]
        c, s = np.cos(heading), np.sin(heading)
        p, q = error[m, 1] + measured[m, 1], -error[m, 0] - measured[m, 0]
        w0 = edges.information[m, 0] * trust[m]
        w1 = edges.information[m, 1] * trust[m]
        w2 = edges.information[m, 2] * trust[m]
        e0, e1, e2 = w0 * error[m, 0], w1 * error[m, 1], w2 * error[m, 2]
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
        for k in range(parameters):
            share = edges.regressors[m, k]
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
            for other in range(parameters):
                share = edges.regressors[m, other]
                corner[k, other] += (b0 * measured[m, 1] / 2 - b1 * measured[m, 0] / 2 - b2) * share


class Equations(NamedTuple):
    """Normal equations of poses and K calibration parameters: the bias, and the turn error if it is free.

    Attributes:
        factor: of the block of the poses, None where it is singular. place: [n] position of each free
            keyframe among the unknowns. right: see `Blocks`. corner [K, K], slope [K]: of the calibration,
            its prior included. weights: [R] robust weights of the closure sequences.
    """

    factor: BlockFactor | None
    place: np.ndarray
    right: np.ndarray
    corner: np.ndarray
    slope: np.ndarray
    weights: np.ndarray

    def step(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Steps of the poses [N, 3] and of the calibration [K]."""
        if self.factor is None:
            return None
        solved, border = self.factor.solve(self.right), self._border()
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
        """[n, 3, K] poses per calibration parameter, in the order of elimination, and [K, K] its information
        with the poses integrated out; infinite and 0 where the equations are singular."""
        border = np.ascontiguousarray(self.right[:, :, 1:])
        if self.factor is None:
            return np.full(border.shape, np.inf), np.zeros(self.corner.shape)
        bent = self.factor.solve(border)
        return bent, self.corner - np.tensordot(border, bent, axes=((0, 1), (0, 1)))

    def _border(self) -> np.ndarray:
        """[3 n, K]"""
        return np.ascontiguousarray(self.right[:, :, 1:]).reshape(-1, len(self.slope))


def empty_blocks(pattern: BlockPattern, parameters: int) -> Blocks:
    """Equations without measurements."""
    return Blocks(
        np.zeros((pattern.count, 3, 3)),
        np.zeros((len(pattern.row), 3, 3)),
        np.zeros((pattern.count, 3, 1 + parameters)),
        np.zeros((parameters, parameters)),
        np.zeros(parameters),
    )
