"""Where raw odometry leads with each of many calibrations, and how likely that makes a closure.

Nothing is linearised: a heading bias or an error of the turns bends a long path so much that no
linearisation holds. So the path is dead reckoned anew for each point of a grid of both. Its covariance is
that of the odometry's noise alone, summed over the steps between two keyframes.
"""

from __future__ import annotations

import numpy as np

from ratslam.mapping.map_state import MapState
from ratslam.mapping.optimizer import CalibrationPrior
from tactile.base.compiled import compiled

BIAS_SPAN, BIAS_STEPS = 0.06, 241
"""Largest difference of a heading bias of the grid from the prior's, rad per cell, and number of biases."""
TURN_SPAN, TURN_STEPS = 3.0, 9
"""Largest difference of a turn error of the grid from the prior's, standard deviations, and number of turn
errors."""
REACH = 3.7
"""Standard deviations of the prior beyond which points of the grid are left out."""
UNLIKELY = -60.0
"""Log ratio of a place that odometry excludes."""
FAR = 100.0
"""Squared distance, in standard deviations, from which a keyframe adds nothing to the density: of a million
keyframes all together less than the rounding of 1."""
TURN = 2 * float(np.pi)


class OdometryScan:
    """Dead-reckoned paths of the keyframes of a map, none merged, for all calibrations of the grid. Holds
    nothing that does not follow from the map, so a checkpoint leaves it out.

    Attributes:
        grid: [G, 2] heading biases, rad/m, and turn errors, rad/rad.
    """

    def __init__(self, state: MapState) -> None:
        prior, spans = state.prior, np.linspace(-TURN_SPAN, TURN_SPAN, TURN_STEPS)
        self._biases = prior.bias + np.linspace(-BIAS_SPAN, BIAS_SPAN, BIAS_STEPS) / state.cell
        turn = prior.turn_error + (spans * prior.turn_error_sd if prior.turn_error_sd > 0 else np.zeros(1))
        self.grid = np.stack(np.meshgrid(self._biases, turn, indexing="ij"), axis=-1).reshape(-1, 2)
        self._near: dict[tuple[CalibrationPrior, float], np.ndarray] = {}
        self.clear()

    def clear(self) -> None:
        """Forgets all paths; they are computed anew from the map."""
        self._count = 1
        self._total = np.zeros((1, 3))  # sums of heading, distance and net turn of the odometry
        self._end = np.zeros((len(self.grid), 2))
        self._path = np.zeros((len(self.grid), 2, 1), np.float32)  # half the memory; 1e-7 of the distance

    def near(self, prior: CalibrationPrior, reach: float = REACH) -> np.ndarray:
        """Points of the grid within `reach` standard deviations of the prior, of bias and turn error
        together; at least three biases."""
        found = self._near.get((prior, reach))
        if found is None:
            if len(self._near) > 1:  # of one prior, as near and wide
                self._near.clear()
            bias, turn_error = np.abs(self.grid - (prior.bias, prior.turn_error)).T
            third = float(np.sort(np.abs(self._biases - prior.bias))[2])
            apart = bias / max(reach * prior.bias_sd, third)
            if prior.turn_error_sd > 0:
                apart = np.hypot(apart, turn_error / (reach * prior.turn_error_sd))
            found = self._near[prior, reach] = np.flatnonzero(apart <= 1)
        return found

    def log_ratios(self, state: MapState, member: np.ndarray, near: np.ndarray) -> np.ndarray:
        """[G] log of the probability density that odometry gave to the place of a closure, over its mean
        density at all keyframes that could be recalled.

        Args:
            state: of all keyframes so far, which grow from call to call. member: keyframe, match and shift
                of the closure. near: points of the grid to compute; elsewhere NaN.
        """
        # Keyframes added since are dead reckoned one at a time: every path has the same bits whenever it is
        # computed.
        held = len(self._total)
        if state.count > held:
            size = max(256, 2 * state.count) - held
            self._total = np.pad(self._total, ((0, size), (0, 0)))
            self._path = np.pad(self._path, ((0, 0), (0, 0), (0, size)))
        motion, length = state.motion.rows, state.length.rows
        _extend_paths(self._path, self._total, self.grid, motion, length, self._count, self._end)
        self._count = max(state.count, 1)
        config = state.config
        j, i, shift = (int(value) for value in member[:3])
        variance = np.ascontiguousarray(state.variances()[i + 1 : j + 1, 1:])
        gate = (config.gate_sd * state.cell) ** 2, config.gate_heading**2
        turned, old = shift * state.sector_angle, max(j - state.guard, 1)
        path, total = self._path, self._total
        return _compute_log_ratios(path, total, self.grid, near, variance, i, j, turned, old, gate)


@compiled
def _extend_paths(
    path: np.ndarray,
    total: np.ndarray,
    grid: np.ndarray,
    motion: np.ndarray,
    length: np.ndarray,
    first: int,
    end: np.ndarray,
) -> None:
    """Continues the paths [G, 2, N] and the sums of heading, distance and net turn [N, 3] by the motions
    [n, 3] over distances [n] from keyframe `first` on; end: [G, 2] of the paths, in double precision."""
    for k in range(first, len(motion)):
        turn = motion[k, 2]
        total[k, 0], total[k, 2] = total[k - 1, 0] + turn, total[k - 1, 2] + turn
        total[k, 1] = total[k - 1, 1] + length[k]
        driven, turned = total[k - 1, 1] + length[k] / 2, total[k - 1, 2] + turn / 2
        for g in range(len(grid)):  # the heading in the middle of the step, with each calibration
            middle = total[k - 1, 0] + driven * grid[g, 0] + turned * grid[g, 1]
            c, s = np.cos(middle), np.sin(middle)
            end[g, 0] += c * motion[k, 0] - s * motion[k, 1]
            end[g, 1] += s * motion[k, 0] + c * motion[k, 1]
            path[g, 0, k], path[g, 1, k] = end[g, 0], end[g, 1]


@compiled
def _compute_log_ratios(
    path: np.ndarray,
    total: np.ndarray,
    grid: np.ndarray,
    points: np.ndarray,
    variance: np.ndarray,
    i: int,
    j: int,
    turned: float,
    old: int,
    gate: tuple[float, float],
) -> np.ndarray:
    """[G] log ratios of a closure of keyframe j with keyframe i, see `OdometryScan.log_ratios`.

    Args:
        path, total: see `_extend_paths`. points: of the grid [G, 2]. variance: [j - i, 2] along and of
            heading into each keyframe between. turned: by which the match is turned, rad. old: number of
            keyframes that could be recalled. gate: variance of position and heading added.
    """
    ratios = np.full(len(grid), np.nan)
    heading, apart = np.empty(j + 1), np.empty(old)
    measured, driven, net = total[: j + 1, 0].copy(), total[: j + 1, 1].copy(), total[: j + 1, 2].copy()
    for g in points:
        bias, turn_error = grid[g, 0], grid[g, 1]
        for k in range(j + 1):
            heading[k] = measured[k] + driven[k] * bias + net[k] * turn_error
        ratio = log_ratio(path[g, 0], path[g, 1], heading, variance, i, j, turned, gate, apart)
        ratios[g] = max(ratio, UNLIKELY)
    return ratios


@compiled
def log_ratio(
    x: np.ndarray,
    y: np.ndarray,
    heading: np.ndarray,
    variance: np.ndarray,
    i: int,
    j: int,
    turned: float,
    gate: tuple[float, float],
    apart: np.ndarray,
) -> float:
    """The log ratio of a closure of keyframe j with keyframe i along one path, see
    `OdometryScan.log_ratios`.

    Args:
        x, y, heading: of the path, m, m, rad. apart: [old] for the squared distances of the keyframes that
            could be recalled. The others: see `_compute_log_ratios`.
    """
    end_x, end_y, end = np.float64(x[j]), np.float64(y[j]), heading[j] + turned
    xx, xy, yy, xh, yh, hh = _invert_covariance(x, y, variance, i, end_x, end_y, gate)
    xy, xh, yh, share, old = 2 * xy, 2 * xh, 2 * yh, 1 / TURN, len(apart)
    for k in range(old):  # squared Mahalanobis distance of each keyframe from the end of the path
        dx, dy, turn = x[k] - end_x, y[k] - end_y, heading[k] - end
        turn -= TURN * np.floor(turn * share + 0.5)
        apart[k] = dx * (xx * dx + xy * dy + xh * turn) + dy * (yy * dy + yh * turn) + hh * turn * turn
    density = 0.0
    for k in range(old):
        if apart[k] < FAR:
            density += np.exp(-apart[k] / 2)
    return np.log(old) - apart[min(i, old - 1)] / 2 - np.log(max(density, 1.0))


@compiled
def _invert_covariance(
    x: np.ndarray,
    y: np.ndarray,
    variance: np.ndarray,
    i: int,
    end_x: float,
    end_y: float,
    gate: tuple[float, float],
) -> tuple[float, float, float, float, float, float]:
    """The information xx, xy, yy, xh, yh, hh of the motion from keyframe i to the end of a path, in the
    frame of the path, with the gate; arguments as of `_compute_log_ratios`."""
    along, heading, sum_x, sum_y, sum_xx, sum_yy, sum_xy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(variance)):
        lever_x, lever_y, spread = end_x - x[i + 1 + k], end_y - y[i + 1 + k], variance[k, 1]
        along += variance[k, 0]
        heading += spread
        sum_x += spread * lever_x
        sum_y += spread * lever_y
        sum_xx += spread * lever_x * lever_x
        sum_yy += spread * lever_y * lever_y
        sum_xy += spread * lever_x * lever_y
    # Rows x, y, heading of the covariance, and its inverse by cofactors.
    a, b, c = sum_yy + gate[0] + along, -sum_xy, -sum_y
    d, e, f = sum_xx + gate[0] + along, sum_x, heading + gate[1]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * aa + b * bb + c * cc
    xx, xy, xh = aa / determinant, bb / determinant, cc / determinant
    yy, yh, hh = a * f - c * c, b * c - a * e, a * d - b * b
    return xx, xy, yy / determinant, xh, yh / determinant, hh / determinant
