"""How well raw odometry foretold a place among all others, for every possible calibration of the odometry.

A heading bias or an error of the turns bends a long path so much that no linearisation holds. So the path is
dead reckoned anew for each point of a grid of both. Its covariance is that of the odometry's noise alone,
summed over the steps between two keyframes. The method is ours."""

from __future__ import annotations

import numpy as np

from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.optimizer import CalibrationPrior

BIAS_SPAN, BIAS_STEPS = 0.06, 241
"""Largest difference of a heading bias of the grid from the prior's, rad per cell, and number of biases."""
TURN_SPAN, TURN_STEPS = 3.0, 9
"""Largest difference of a turn error of the grid from the prior's, standard deviations, and number of turn
errors."""
REACH = 3.7
"""Standard deviations of the prior beyond which points of the grid are left out."""
UNLIKELY = -60.0
"""Log ratio of a place that odometry excludes."""
POINTS = 64
"""Points of the grid that are computed together: few enough that their paths stay in the processor's
cache."""


class OdometryScan:
    """Dead-reckoned paths of a keyframe graph for all calibrations of the grid. Holds nothing that does not
    follow from the graph, so a checkpoint leaves it out.

    Attributes:
        grid: [G, 2] heading biases, rad/m, and turn errors, rad/rad.
    """

    def __init__(self, graph: KeyframeGraph) -> None:
        self._graph = graph
        prior, spans = graph.prior, np.linspace(-TURN_SPAN, TURN_SPAN, TURN_STEPS)
        bias = prior.bias + np.linspace(-BIAS_SPAN, BIAS_SPAN, BIAS_STEPS) / graph.cell
        turn = prior.turn_error + (spans * prior.turn_error_sd if prior.turn_error_sd > 0 else np.zeros(1))
        self.grid = np.stack(np.meshgrid(bias, turn, indexing="ij"), axis=-1).reshape(-1, 2)
        self.clear()

    def clear(self) -> None:
        """Forgets all paths; they are computed anew from the graph."""
        self._count = 1
        self._total = np.zeros((1, 3))  # sums of heading, distance and net turn of the odometry
        self._end = np.zeros(len(self.grid), complex)
        self._position = np.zeros((1, len(self.grid)), np.complex64)  # half the memory; 1e-7 of the distance

    def near(self, prior: CalibrationPrior, reach: float = REACH) -> np.ndarray:
        """Points of the grid within `reach` standard deviations of the prior, of bias and turn error
        together; at least three biases."""
        bias, turn_error = np.abs(self.grid - (prior.bias, prior.turn_error)).T
        third = float(np.sort(np.abs(np.unique(self.grid[:, 0]) - prior.bias))[2])
        apart = bias / max(reach * prior.bias_sd, third)
        if prior.turn_error_sd > 0:
            apart = np.hypot(apart, turn_error / (reach * prior.turn_error_sd))
        return np.flatnonzero(apart <= 1)

    def log_ratios(self, member: np.ndarray, near: np.ndarray) -> np.ndarray:
        """[G] log of the probability density that odometry gave to the place of a closure, over its mean
        density at all keyframes that could be recalled.

        Args:
            member: keyframe, match and shift of the closure. near: points of the grid to compute; elsewhere
                NaN.
        """
        self._extend()
        ratios = np.full(len(self.grid), np.nan)
        for first in range(0, len(near), POINTS):
            points = near[first : first + POINTS]
            ratios[points] = self._ratios_at(member, points)
        return ratios

    def _ratios_at(self, member: np.ndarray, points: np.ndarray) -> np.ndarray:
        """[g] of `log_ratios` at these points of the grid."""
        j, i, shift = (int(value) for value in member[:3])
        heading = self._total[: j + 1, :1] + self._total[: j + 1, 1:] @ self.grid[points].T
        position = self._position[: j + 1, points].astype(complex)
        root = np.linalg.cholesky(np.linalg.inv(self._covariance(i, j, position)))  # of the information
        old = max(j - self._graph.guard, 1)
        x, y = position.real[:old] - position.real[j], position.imag[:old] - position.imag[j]
        turned = heading[:old] - shift * self._graph.sector_angle - heading[j]
        turned -= 2 * np.pi * np.rint(turned / (2 * np.pi))
        along = root[:, 0, 0] * x + root[:, 1, 0] * y + root[:, 2, 0] * turned
        across = root[:, 1, 1] * y + root[:, 2, 1] * turned
        distance = along**2 + across**2 + (root[:, 2, 2] * turned) ** 2
        total = np.maximum(np.exp(-distance / 2).sum(axis=0), 1.0)
        return np.maximum(np.log(old) - distance[i] / 2 - np.log(total), UNLIKELY)

    def _covariance(self, i: int, j: int, position: np.ndarray) -> np.ndarray:
        """[g, 3, 3] covariance of the motion from keyframe i to j in the frame of the path, with the gate.

        Args:
            position: [j + 1, g] of all keyframes up to j.
        """
        config, graph = self._graph.config, self._graph
        variance = graph.variances(graph.cut)[i + 1 : j + 1, 1:]
        along, heading = variance.sum(axis=0)
        lever = position[j] - position[i + 1 : j + 1]
        x, y = lever.real, lever.imag
        gate = (config.gate_sd * graph.cell) ** 2 + along
        covariance = np.empty((position.shape[1], 3, 3))
        covariance[:, 0, 0] = variance[:, 1] @ y**2 + gate
        covariance[:, 1, 1] = variance[:, 1] @ x**2 + gate
        covariance[:, 0, 1] = covariance[:, 1, 0] = -(variance[:, 1] @ (x * y))
        covariance[:, 0, 2] = covariance[:, 2, 0] = -(variance[:, 1] @ y)
        covariance[:, 1, 2] = covariance[:, 2, 1] = variance[:, 1] @ x
        covariance[:, 2, 2] = heading + config.gate_heading**2
        return covariance

    def _extend(self) -> None:
        """Dead reckons the keyframes added since the last call, one at a time, so that every path has the
        same bits whenever it is computed."""
        graph = self._graph
        self._reserve(graph.count)
        for k in range(self._count, graph.count):
            motion, length = graph.motion.rows[k], graph.length.rows[k]
            before, step = self._total[k - 1], np.array([motion[2], length, motion[2]])
            self._total[k] = before + step
            middle = before[0] + (before[1:] + step[1:] / 2) @ self.grid.T
            self._end = self._end + complex(motion[0], motion[1]) * np.exp(1j * middle)
            self._position[k] = self._end
        self._count = max(graph.count, 1)

    def _reserve(self, count: int) -> None:
        if count <= len(self._total):
            return
        for name in ("_total", "_position"):
            old = getattr(self, name)
            new = np.zeros((max(256, 2 * count), *old.shape[1:]), old.dtype)
            new[: len(old)] = old
            setattr(self, name, new)
