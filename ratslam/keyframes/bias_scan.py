"""How well raw odometry foretold a place among all others, at every possible heading bias.

A heading bias bends a long path so much that no linearisation holds. So the path is dead reckoned anew with
each bias of a grid. Its covariance is that of the odometry's noise alone, from running sums: with P the
position and h the heading variance of one step, it needs the sums of h, h P and h P P'. The method is ours.
"""

from __future__ import annotations

import numpy as np

from ratslam.keyframes.keyframe_graph import KeyframeGraph
from ratslam.keyframes.optimizer import BiasPrior
from tactile.base.se2 import wrap

SPAN = 0.06
"""Largest heading bias of the grid, rad per cell."""
STEPS = 241
"""Number of biases in the grid."""
REACH = 3.7
"""Standard deviations of the prior beyond which biases are left out."""
UNLIKELY = -60.0
"""Log ratio of a place that odometry excludes."""


class BiasScan:
    """Dead-reckoned paths of a keyframe graph for all biases of the grid. Holds nothing that does not follow
    from the graph, so a checkpoint leaves it out.

    Attributes:
        grid: [B] heading biases, rad/m.
    """

    def __init__(self, graph: KeyframeGraph) -> None:
        self._graph = graph
        self.grid = np.linspace(-SPAN, SPAN, STEPS) / graph.cell
        self.clear()

    def clear(self) -> None:
        """Forgets all paths; they are computed anew from the graph."""
        self._count, self._cut = 1, np.zeros(1, bool)
        self._heading = np.zeros((0, STEPS))
        self._position = np.zeros((0, STEPS), complex)
        self._moment = np.zeros((0, STEPS), complex)  # sum of h P
        self._second = np.zeros((0, 3, STEPS))  # sums of h x x, h y y, h x y
        self._variance = np.zeros((0, 2))  # sums of position and heading variance

    def log_ratios(self, member: np.ndarray, prior: BiasPrior) -> np.ndarray:
        """[B] log of the probability density that odometry gave to the place of a closure, over its mean
        density at all keyframes that could be recalled.

        Args:
            member: keyframe, match and shift of the closure. prior: of the bias; beyond it `UNLIKELY`.
        """
        self._extend()
        j, i, shift = (int(value) for value in member[:3])
        near = np.flatnonzero(np.abs(self.grid - prior.mean) < REACH * prior.sd)
        if len(near) < 3:
            near = np.sort(np.argsort(np.abs(self.grid - prior.mean), kind="stable")[:3])
        root = np.linalg.cholesky(np.linalg.inv(self._covariance(i, j, near)))  # of the information
        old = max(j - self._graph.guard, 1)
        apart = self._position[:old, near] - self._position[j, near]
        turn = -shift * self._graph.sector_angle
        turned = wrap(self._heading[:old, near] + turn - self._heading[j, near])
        along = root[:, 0, 0] * apart.real + root[:, 1, 0] * apart.imag + root[:, 2, 0] * turned
        across = root[:, 1, 1] * apart.imag + root[:, 2, 1] * turned
        distance = along**2 + across**2 + (root[:, 2, 2] * turned) ** 2
        total = np.maximum(np.exp(-distance / 2).sum(axis=0), 1.0)
        ratios = np.full(STEPS, UNLIKELY)
        ratios[near] = np.maximum(np.log(old) - distance[i] / 2 - np.log(total), UNLIKELY)
        return ratios

    def _covariance(self, i: int, j: int, near: np.ndarray) -> np.ndarray:
        """[n, 3, 3] covariance of the motion from keyframe i to j in the frame of the path, with the gate."""
        config, cell = self._graph.config, self._graph.cell
        along, heading = self._variance[j] - self._variance[i]
        moment = (self._moment[j] - self._moment[i])[near]
        xx, yy, xy = (self._second[j] - self._second[i])[:, near]
        x, y = self._position[j, near].real, self._position[j, near].imag
        gate = (config.gate_sd * cell) ** 2 + along
        covariance = np.empty((len(near), 3, 3))
        covariance[:, 0, 0] = heading * y**2 - 2 * y * moment.imag + yy + gate
        covariance[:, 1, 1] = heading * x**2 - 2 * x * moment.real + xx + gate
        cross = heading * x * y - x * moment.imag - y * moment.real + xy
        covariance[:, 0, 1] = covariance[:, 1, 0] = -cross
        covariance[:, 0, 2] = covariance[:, 2, 0] = -(heading * y - moment.imag)
        covariance[:, 1, 2] = covariance[:, 2, 1] = heading * x - moment.real
        covariance[:, 2, 2] = heading + config.gate_heading**2
        return covariance

    def _extend(self) -> None:
        """Dead reckons the keyframes added since the last call, one at a time, so that every path has the
        same bits whenever it is computed; all of them if the odometry was cut since."""
        graph, cut = self._graph, self._graph.cut.rows >= 0
        if not np.array_equal(cut[: self._count], self._cut):
            self.clear()
        self._reserve(graph.count)
        variances = graph.variances(graph.cut)[:, 1:]
        for k in range(self._count, graph.count):
            motion, length = graph.motion.rows[k], graph.length.rows[k]
            along, heading = variances[k]
            middle = self._heading[k - 1] + self.grid * (length / 2)
            self._heading[k] = self._heading[k - 1] + (motion[2] + self.grid * length)
            position = self._position[k - 1] + complex(motion[0], motion[1]) * np.exp(1j * middle)
            x, y = position.real, position.imag
            self._position[k] = position
            self._moment[k] = self._moment[k - 1] + heading * position
            self._second[k] = self._second[k - 1] + heading * np.stack([x * x, y * y, x * y])
            self._variance[k] = self._variance[k - 1] + (along, heading)
        self._count, self._cut = max(graph.count, 1), cut

    def _reserve(self, count: int) -> None:
        if count <= len(self._heading):
            return
        for name in ("_heading", "_position", "_moment", "_second", "_variance"):
            old = getattr(self, name)
            new = np.zeros((max(256, 2 * count), *old.shape[1:]), old.dtype)
            new[: len(old)] = old
            setattr(self, name, new)
