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
def add_to_pose(
    blocks: Blocks, at: int, by_pose: np.ndarray, by_parameter: np.ndarray, weight: float, error: float
) -> None:
    """Adds one row of a measurement, with derivatives by a pose [3] and by the calibration [K]."""
    for p in range(3):
        pulled = weight * by_pose[p]
        blocks.right[at, p, 0] -= pulled * error
        for k in range(len(by_parameter)):
            blocks.right[at, p, 1 + k] += pulled * by_parameter[k]
        for q in range(3):
            blocks.diagonal[at, p, q] += pulled * by_pose[q]


@compiled
def add_measurements(
    edges: Measurements,
    poses: np.ndarray,
    measured: np.ndarray,
    error: np.ndarray,
    trust: np.ndarray,
    blocks: Blocks,
) -> None:
    """Adds the measurements, each with its information times `trust` [M], to the equations."""
    parameters = edges.regressors.shape[1]
    by_i, by_j, by_parameter = np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, parameters))
    by_j[2, 2] = 1.0
    by_i[2, 0] = by_i[2, 1] = 0.0
    by_i[2, 2] = -1.0
    for m in range(len(trust)):
        heading, at_i, at_j = poses[edges.i[m], 2], edges.at_i[m], edges.at_j[m]
        c, s = np.cos(heading), np.sin(heading)
        by_i[0, 0], by_i[0, 1], by_i[0, 2] = -c, -s, error[m, 1] + measured[m, 1]
        by_i[1, 0], by_i[1, 1], by_i[1, 2] = s, -c, -error[m, 0] - measured[m, 0]
        by_j[0, 0], by_j[0, 1], by_j[1, 0], by_j[1, 1] = c, s, -s, c
        for k in range(parameters):
            by_parameter[0, k] = measured[m, 1] / 2 * edges.regressors[m, k]
            by_parameter[1, k] = -measured[m, 0] / 2 * edges.regressors[m, k]
            by_parameter[2, k] = -edges.regressors[m, k]
        for row in range(3):
            weight = edges.information[m, row] * trust[m]
            off = error[m, row]
            if at_i >= 0:
                add_to_pose(blocks, at_i, by_i[row], by_parameter[row], weight, off)
            if at_j >= 0:
                add_to_pose(blocks, at_j, by_j[row], by_parameter[row], weight, off)
            if edges.slot[m] >= 0:
                upper, lower = (by_i[row], by_j[row]) if at_i < at_j else (by_j[row], by_i[row])
                for p in range(3):
                    for q in range(3):
                        blocks.above[edges.slot[m], p, q] += weight * upper[p] * lower[q]
            for k in range(parameters):
                pulled = weight * by_parameter[row, k]
                blocks.slope[k] += pulled * off
                for other in range(parameters):
                    blocks.corner[k, other] += pulled * by_parameter[row, other]


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
        _, schur = self._bent(self.factor)
        return self.factor.log_determinant + float(np.linalg.slogdet(schur)[1])

    def calibration_covariance(self) -> np.ndarray:
        """[K, K] of the calibration parameters."""
        if self.factor is None:
            return np.full(self.corner.shape, np.inf)
        return np.linalg.inv(self._bent(self.factor)[1])

    def covariance(self, change: np.ndarray) -> np.ndarray:
        """[n, n] covariance of quantities with derivatives [N - 1, 3, n] by the free keyframes' poses."""
        if self.factor is None:
            return np.full((change.shape[2],) * 2, np.inf)
        ordered = np.empty_like(change)
        ordered[self.place] = change
        spread = self.factor.solve(ordered).reshape(-1, change.shape[2])
        ordered = ordered.reshape(spread.shape)
        bent, schur = self._bent(self.factor)
        pull = ordered.T @ bent
        return ordered.T @ spread + pull @ np.linalg.solve(schur, pull.T)

    def _border(self) -> np.ndarray:
        """[3 n, K]"""
        return np.ascontiguousarray(self.right[:, :, 1:]).reshape(-1, len(self.slope))

    def _bent(self, factor: BlockFactor) -> tuple[np.ndarray, np.ndarray]:
        """[3 n, K] poses per calibration parameter, and [K, K] its information with the poses integrated
        out."""
        border = self._border()
        bent = factor.solve(self.right[:, :, 1:]).reshape(border.shape)
        return bent, self.corner - border.T @ bent


def empty_blocks(pattern: BlockPattern, parameters: int) -> Blocks:
    """Equations without measurements."""
    return Blocks(
        np.zeros((pattern.count, 3, 3)),
        np.zeros((len(pattern.row), 3, 3)),
        np.zeros((pattern.count, 3, 1 + parameters)),
        np.zeros((parameters, parameters)),
        np.zeros(parameters),
    )
