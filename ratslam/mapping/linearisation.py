"""The normal equations of the keyframes' poses, which stand in blocks, and of the odometry's calibration.

Keyframe 0 is fixed. Keyframes without a number among the unknowns, position -1, add nothing to the equations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.core.compiled import compiled
from ratslam.mapping.block_cholesky import BlockFactor, BlockPattern

PI = float(np.pi)


class Measurements(NamedTuple):
    """M relative poses of keyframes and what is known of them.

    Attributes:
        i, j: [M] keyframes. motion: [M, 3] measured pose of keyframe j in the frame of keyframe i (m, m,
            rad). information: [M, 3] of it. regressors: [M, 2] distance (m) and turn (rad) by which heading
            bias and turn error bend each measurement, 0 for closures.
        at_i, at_j: [M] position of the keyframes in the order of elimination, -1 for keyframe 0.
        slot: [M] block above the diagonal, -1 for edges of keyframe 0.
    """

    i: np.ndarray
    j: np.ndarray
    motion: np.ndarray
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
    edges: Measurements, poses: np.ndarray, bias: float, turn_error: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The measurements [M, 3] without the systematic errors of the odometry, their errors [M, 3] (m, m, rad),
    and their chi-squares [M]."""
    count = len(edges.i)
    measured, error, chi2 = np.empty((count, 3)), np.empty((count, 3)), np.empty(count)
    for m in range(count):
        a, b = edges.i[m], edges.j[m]
        turn = bias * edges.regressors[m, 0] + turn_error * edges.regressors[m, 1]
        c, s = np.cos(turn / 2), np.sin(turn / 2)
        x, y, heading = edges.motion[m, 0], edges.motion[m, 1], edges.motion[m, 2]
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
            total += error[m, r] ** 2 * edges.information[m, r]
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
    by the pose of keyframe i, and [c s 0], [-s c 0], [0 0 1] by that of keyframe j. The products are written
    out, because loops over their many zeros take several times as long.
    """
    diagonal, above, right, corner, slope = blocks
    parameters = len(slope)
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
