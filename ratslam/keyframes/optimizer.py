"""Robust SE(2) least squares over a chain of keyframes with closure sequences and the odometry's calibration.

A constant turn of the odometry to one side, the heading bias (rad/m), and the share by which its turns are
wrong, the turn error (rad/rad), are solved for with the poses. Each closure sequence has one robust weight,
because its closures are right or wrong together. Keyframe 0 is fixed. Sources: Geman & McClure 1985 (the
kernel); Kuemmerle et al. 2011 (the error); the calibration and the weights by sequence are ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from tactile.base.se2 import between, correct_heading, wrap


class OdometryChain(NamedTuple):
    """Odometry between consecutive keyframes.

    Attributes:
        motion: [N - 1, 3] pose of the later keyframe in the frame of the earlier one (m, m, rad).
        length: [N - 1] distance travelled, m. variance: [N - 1, 3] of the motion.
    """

    motion: np.ndarray
    length: np.ndarray
    variance: np.ndarray


class LoopClosures(NamedTuple):
    """Loop closures: keyframe j has the position of keyframe i, and its heading plus `turn`.

    Attributes:
        i, j: [M] keyframes. turn: [M] rad. sequence: [M] the sequence of each, 0..R - 1. variance: [3] of
            each. scale: [R] mean chi-square at which the weight of a sequence is a quarter. score: [R]
            evidence. cost_limit: largest chi-square of one closure, [R] by sequence or one for all.
    """

    i: np.ndarray
    j: np.ndarray
    turn: np.ndarray
    sequence: np.ndarray
    variance: np.ndarray
    scale: np.ndarray
    score: np.ndarray = np.zeros(0)
    cost_limit: np.ndarray | float = np.inf


class CalibrationPrior(NamedTuple):
    """Prior means and standard deviations of the odometry's heading bias, rad/m, and turn error, rad/rad; a
    standard deviation of 0 fixes the turn error."""

    bias: float
    bias_sd: float
    turn_error: float = 0.0
    turn_error_sd: float = 0.0


class MapProblem(NamedTuple):
    """The measurements that a map is fitted to."""

    chain: OdometryChain
    closures: LoopClosures
    prior: CalibrationPrior


class MapFit(NamedTuple):
    """Poses [N, 3], heading bias (rad/m), the robust weight [R] of each sequence, and the turn error
    (rad/rad)."""

    poses: np.ndarray
    bias: float
    weights: np.ndarray
    turn_error: float = 0.0

    def corrected(self, chain: OdometryChain) -> np.ndarray:
        """[N - 1, 3] the chain's motions without their systematic errors."""
        return correct_heading(chain.motion, chain.length, self.bias, self.turn_error)


def solve(start: MapFit, problem: MapProblem, iterations: int, tolerance: float = 1e-4) -> MapFit:
    """Gauss-Newton with one robust weight per sequence, from the poses and calibration of `start`.

    Returns:
        the fit after the first step that changes every pose by less than the tolerance (m, rad), or after
        `iterations` steps; the last fit before the equations become singular.
    """
    system = _System(problem)
    weights = np.ones(len(problem.closures.scale))
    fit = MapFit(np.array(start.poses, float), start.bias, weights, start.turn_error)
    for _ in range(iterations):
        equations = system.linearise(fit)
        fit = fit._replace(weights=equations.weights)
        step = equations.step()
        if step is None:
            break
        moved = fit.poses + step[0]
        moved[:, 2] = wrap(moved[:, 2])
        bias, turn_error = fit.bias + step[1][0], fit.turn_error + sum(step[1][1:])
        fit = fit._replace(poses=moved, bias=float(bias), turn_error=float(turn_error))
        if np.abs(step[0]).max(initial=0.0) < tolerance:
            break
    return fit


def robust_cost(fit: MapFit, problem: MapProblem) -> float:
    """The cost that `solve` minimises: chi-square of odometry and calibration and robust cost of closures."""
    chain, closures, prior = problem
    apart = between(fit.poses[:-1], fit.poses[1:]) - fit.corrected(chain)
    apart[:, 2] = wrap(apart[:, 2])
    odometry = float((apart**2 / chain.variance).sum())
    error = between(fit.poses[closures.i], fit.poses[closures.j])
    error[:, 2] = wrap(error[:, 2] - closures.turn)
    spread = np.broadcast_to(closures.variance, error.shape)
    members = np.bincount(closures.sequence, minlength=len(closures.scale))
    _, mean = _mean_costs((error**2 / spread).sum(axis=1), closures, members)
    lost = members * closures.scale * mean / (closures.scale + mean)
    off, tight = _calibration(fit, prior)
    return odometry + float(lost.sum()) + float((tight * off**2).sum())


def log_evidence(fit: MapFit, problem: MapProblem) -> float:
    """Log probability of odometry and closures with poses and calibration integrated out, to second order
    around a fit that solves the problem (Laplace's method); up to a constant that does not depend on the
    variances of the odometry. -inf where the equations are singular."""
    information = _System(problem).linearise(fit).log_determinant()
    spread = float(np.log(problem.chain.variance).sum())
    return -0.5 * (robust_cost(fit, problem) + information + spread)


def _calibration(fit: MapFit, prior: CalibrationPrior) -> tuple[np.ndarray, np.ndarray]:
    """[K] deviation of the free calibration parameters from their prior, and its information."""
    off = [fit.bias - prior.bias, fit.turn_error - prior.turn_error]
    sd = np.array([prior.bias_sd, prior.turn_error_sd])
    free = 1 + int(sd[1] > 0)
    return np.array(off[:free]), 1 / sd[:free] ** 2


class MapCovariance:
    """The exact marginals of the linearised problem, the calibration included: it moves distant keyframes
    together."""

    def __init__(self, fit: MapFit, problem: MapProblem) -> None:
        self._poses, self._equations = fit.poses, _System(problem).linearise(fit)

    def calibration_sd(self) -> tuple[float, float]:
        """Standard deviations of heading bias, rad/m, and turn error, rad/rad (0 where it is fixed)."""
        sd = np.sqrt(np.diag(self._equations.calibration_covariance()))
        return float(sd[0]), float(sd[1]) if len(sd) > 1 else 0.0

    def relative(self, i: int, j: int, turn: float) -> np.ndarray:
        """[3, 3] covariance of keyframe j in the frame of keyframe i turned by `turn`."""
        a, b = self._poses[i], self._poses[j]
        c, s = np.cos(a[2] + turn), np.sin(a[2] + turn)
        dx, dy = (b - a)[:2]
        by_i = np.array([[-c, -s, c * dy - s * dx], [s, -c, -c * dx - s * dy], [0, 0, -1.0]])
        by_j = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        change = np.zeros((len(self._poses), 3, 3))
        change[i], change[j] = by_i.T, by_j.T
        return self._equations.covariance(change[1:])


def _mean_costs(
    chi2: np.ndarray, closures: LoopClosures, members: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Weights [M] of single closures that limit the chi-square [M] of each to `cost_limit`, so that one wrong
    closure does not cost its whole sequence; and the mean limited chi-square [R] of each sequence."""
    limit = np.broadcast_to(closures.cost_limit, closures.scale.shape)[closures.sequence]
    weights = np.ones_like(chi2)
    if np.isfinite(limit).all():
        share = limit / (limit + chi2)
        weights, chi2 = share**2, share * chi2
    return weights, np.bincount(closures.sequence, chi2, len(members)) / np.maximum(members, 1)


class _Equations(NamedTuple):
    """Normal equations of poses and K calibration parameters: the bias, and the turn error if it is free.

    Attributes:
        factor: of the block of the poses, None where it is singular. order: [N - 1] position of each free
            keyframe among the unknowns. gradient [n], border [n, K], corner [K, K], slope [K]: the other
            blocks of the equations.
    """

    factor: SuperLU | None
    order: np.ndarray
    gradient: np.ndarray
    border: np.ndarray
    corner: np.ndarray
    slope: np.ndarray
    weights: np.ndarray

    def step(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Steps of the poses [N, 3] and of the calibration [K]."""
        if self.factor is None:
            return None
        solved = self.factor.solve(np.column_stack([-self.gradient, self.border]))
        free, bent = solved[:, 0], solved[:, 1:]
        change = np.linalg.solve(self._schur(bent), -self.slope - self.border.T @ free)
        step = free - bent @ change
        if not np.isfinite(step).all():
            return None
        return np.concatenate([np.zeros((1, 3)), step.reshape(-1, 3)[self.order]]), change

    def _schur(self, bent: np.ndarray) -> np.ndarray:
        return self.corner - self.border.T @ bent

    def log_determinant(self) -> float:
        """Of the information of all unknowns; inf where it is singular."""
        if self.factor is None:
            return float(np.inf)
        schur = self._schur(self.factor.solve(self.border))
        pivots = np.abs(self.factor.U.diagonal())
        return float(np.log(pivots).sum() + np.linalg.slogdet(schur)[1])

    def calibration_covariance(self) -> np.ndarray:
        """[K, K] of the calibration parameters."""
        if self.factor is None:
            return np.full(self.corner.shape, np.inf)
        return np.linalg.inv(self._schur(self.factor.solve(self.border)))

    def covariance(self, change: np.ndarray) -> np.ndarray:
        """[n, n] covariance of quantities with derivatives [N - 1, 3, n] by the free keyframes' poses."""
        if self.factor is None:
            return np.full((change.shape[2],) * 2, np.inf)
        change = change[np.argsort(self.order)].reshape(-1, change.shape[2])
        spread = self.factor.solve(change)
        bent = self.factor.solve(self.border)
        pull = change.T @ bent
        return change.T @ spread + pull @ np.linalg.solve(self._schur(bent), pull.T)


class _System:
    """The sparsity pattern of the normal equations, computed once for a set of edges."""

    def __init__(self, problem: MapProblem) -> None:
        chain, closures, self.prior = problem
        count, steps = len(chain.length) + 1, np.arange(len(chain.length))
        self.i, self.j = np.concatenate([steps, closures.i]), np.concatenate([steps + 1, closures.j])
        self.motion = np.concatenate([chain.motion, np.zeros((len(closures.i), 3))])
        self.motion[len(steps) :, 2] = closures.turn
        self.length = np.concatenate([chain.length, np.zeros(len(closures.i))])
        self.odometry = np.arange(len(self.i)) < len(steps)
        turn = np.where(self.odometry, self.motion[:, 2], 0.0)
        self.regressors = np.column_stack([self.length, turn])[:, : 1 + int(self.prior.turn_error_sd > 0)]
        spread = np.broadcast_to(closures.variance, (len(closures.i), 3))
        self.information = 1 / np.concatenate([chain.variance, spread])
        self.closures, self.chained = closures, len(steps)
        self.members = np.bincount(closures.sequence, minlength=len(closures.scale))

        self.size = 3 * (count - 1)
        self.order = _order(self.i, self.j, count)
        ends = 3 * np.stack([self.order[self.i], self.order[self.j]], axis=1)[:, :, None]
        at = (ends + np.arange(3)).reshape(-1, 6)  # keyframe 0 is fixed: its rows are omitted
        self.free, self.row = at >= 0, at[at >= 0]
        rows, columns = np.repeat(at[:, :, None], 6, axis=2), np.repeat(at[:, None, :], 6, axis=1)
        self.used = (rows >= 0) & (columns >= 0)
        flat = columns[self.used] * self.size + rows[self.used]
        places, self.slot = np.unique(flat, return_inverse=True)
        self.count, self.indices = len(places), (places % self.size).astype(np.int32)
        self.indptr = np.searchsorted(places // self.size, np.arange(self.size + 1)).astype(np.int32)

    def linearise(self, fit: MapFit) -> _Equations:
        a, b = fit.poses[self.i], fit.poses[self.j]
        c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
        dx, dy = (b - a)[:, 0], (b - a)[:, 1]
        measured = correct_heading(self.motion, self.length, fit.bias, fit.turn_error * self.odometry)
        ahead, aside = c * dx + s * dy, c * dy - s * dx
        error = np.stack(
            [ahead - measured[:, 0], aside - measured[:, 1], wrap(b[:, 2] - a[:, 2] - measured[:, 2])], 1
        )
        chi2 = (error**2 * self.information).sum(axis=1)
        keep, mean = _mean_costs(chi2[self.chained :], self.closures, self.members)
        weights = (self.closures.scale / (self.closures.scale + mean)) ** 2

        jacobian = np.zeros((len(a), 3, 6))
        jacobian[:, 0, :3] = np.stack([-c, -s, aside], axis=1)
        jacobian[:, 1, :3] = np.stack([s, -c, -ahead], axis=1)
        jacobian[:, 0, 3], jacobian[:, 0, 4], jacobian[:, 1, 3], jacobian[:, 1, 4] = c, s, -s, c
        jacobian[:, 2, 2], jacobian[:, 2, 5] = -1.0, 1.0
        by_turn = np.stack([measured[:, 1] / 2, -measured[:, 0] / 2, -np.ones(len(a))], 1)
        by_parameter = by_turn[:, :, None] * self.regressors[:, None, :]

        trust = self.information.copy()
        trust[self.chained :] *= (keep * weights[self.closures.sequence])[:, None]
        weighted = np.swapaxes(jacobian, 1, 2) * trust[:, None, :]
        data = np.bincount(self.slot, (weighted @ jacobian)[self.used], self.count)
        pulled = weighted @ np.concatenate([error[:, :, None], by_parameter], axis=2)
        gradient, *border = (
            np.bincount(self.row, pulled[:, :, k][self.free], self.size) for k in range(pulled.shape[2])
        )
        matrix = csc_matrix((data, self.indices, self.indptr), (self.size, self.size))
        off, tight = _calibration(fit, self.prior)
        trusted = by_parameter * trust[:, :, None]
        return _Equations(
            _factor(matrix),
            self.order[1:],
            gradient,
            np.stack(border, axis=1),
            np.einsum("mak,mal->kl", trusted, by_parameter) + np.diag(tight),
            np.einsum("mak,ma->k", trusted, error) + tight * off,
            weights,
        )


def _order(i: np.ndarray, j: np.ndarray, count: int) -> np.ndarray:
    """[N] position of each keyframe among the unknowns, -1 for keyframe 0: SuperLU's minimum-degree order,
    computed once for keyframes instead of at every step for their coordinates."""
    free = (i > 0) & (j > 0)
    i, j = i[free] - 1, j[free] - 1
    ends, size = np.arange(count - 1), count - 1
    ties = np.ones(len(i))
    # Only the sparsity pattern matters; the diagonal makes the matrix regular.
    among = csc_matrix((ties, (i, j)), (size, size))
    degree = csc_matrix((np.full(size, 4.0 * len(i) + 1), (ends, ends)), (size, size))
    factor = _decompose(among + among.T + degree, "MMD_AT_PLUS_A")
    return np.concatenate([[-1], factor.perm_c])


def _factor(matrix: csc_matrix) -> SuperLU | None:
    try:
        return _decompose(matrix, "NATURAL")
    except RuntimeError:  # singular: a keyframe is not connected to keyframe 0
        return None


def _decompose(matrix: csc_matrix, ordering: str) -> SuperLU:
    return splu(matrix, permc_spec=ordering, options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
