"""A chain of frames with closures in sequences and one heading bias: robust SE(2) least squares.

Odometry that always pulls to one side is one number, not many errors: the bias, in radians per metre, is
solved for with the poses. Closures that were recognised together stand or fall together: a sequence has one
robust weight. Frame 0 is held where it is. Sources: Geman & McClure 1985 (the kernel); Kuemmerle et al. 2011
(the error); the bias and the weights by sequence are ours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import SuperLU, splu

from tactile.base.se2 import between, correct_heading_bias, wrap


class OdometryChain(NamedTuple):
    """What odometry says from each frame to the next.

    Attributes:
        motion: [N - 1, 3] the later frame in the earlier one (m, m, rad). length: [N - 1] m travelled.
        variance: [N - 1, 3] of the motion.
    """

    motion: np.ndarray
    length: np.ndarray
    variance: np.ndarray


class LoopClosures(NamedTuple):
    """What recall says: frame j stands where frame i does, turned by `turn`.

    Attributes:
        i, j: [M] frames. turn: [M] rad. sequence: [M] which sequence each belongs to, 0..R - 1. variance: [3]
        of each. scale: [R] mean chi-square at which the weight of a sequence has fallen to a quarter. score:
        [R] evidence. stray: [R] or for all sequences, chi-square that one closure counts at most.
    """

    i: np.ndarray
    j: np.ndarray
    turn: np.ndarray
    sequence: np.ndarray
    variance: np.ndarray
    scale: np.ndarray
    score: np.ndarray = np.zeros(0)
    stray: np.ndarray | float = np.inf


class BiasPrior(NamedTuple):
    """What is known of the heading bias beforehand, rad/m."""

    mean: float
    sd: float


class MapFit(NamedTuple):
    """Poses [N, 3], heading bias rad/m, the weight [R] of each sequence."""

    poses: np.ndarray
    bias: float
    weights: np.ndarray


def solve(
    poses: np.ndarray,
    bias: float,
    chain: OdometryChain,
    closures: LoopClosures,
    prior: BiasPrior,
    iterations: int,
    tolerance: float = 1e-4,
) -> MapFit:
    """Gauss-Newton with weights by sequence, from the given poses [N, 3] and bias.

    Returns:
        the fit after the last step that changed anything by more than the tolerance (m, rad), `iterations` at
        most; where the equations cannot be solved, what it had before.
    """
    system = _System(chain, closures, prior)
    fit = MapFit(np.array(poses, float), bias, np.ones(len(closures.scale)))
    for _ in range(iterations):
        equations = system.linearise(fit)
        fit = fit._replace(weights=equations.weights)
        step = equations.step()
        if step is None:
            break
        moved = fit.poses + step[0]
        moved[:, 2] = wrap(moved[:, 2])
        fit = fit._replace(poses=moved, bias=fit.bias + step[1])
        if np.abs(step[0]).max(initial=0.0) < tolerance:
            break
    return fit


def robust_cost(fit: MapFit, chain: OdometryChain, closures: LoopClosures, prior: BiasPrior) -> float:
    """What is left of the contradictions between odometry and closures under a fit: what `solve` lessens."""
    measured = correct_heading_bias(chain.motion, chain.length, fit.bias)
    apart = between(fit.poses[:-1], fit.poses[1:]) - measured
    apart[:, 2] = wrap(apart[:, 2])
    odometry = float((apart**2 / chain.variance).sum())
    error = between(fit.poses[closures.i], fit.poses[closures.j])
    error[:, 2] = wrap(error[:, 2] - closures.turn)
    spread = np.broadcast_to(closures.variance, error.shape)
    members = np.bincount(closures.sequence, minlength=len(closures.scale))
    _, tamed = _tamed((error**2 / spread).sum(axis=1), closures)
    total = np.bincount(closures.sequence, tamed, len(closures.scale))
    mean = total / np.maximum(members, 1)
    lost = members * closures.scale * mean / (closures.scale + mean)
    return odometry + float(lost.sum()) + ((fit.bias - prior.mean) / prior.sd) ** 2


def relative_covariance(
    fit: MapFit, chain: OdometryChain, closures: LoopClosures, prior: BiasPrior, i: int, j: int, turn: float
) -> np.ndarray:
    """[3, 3] covariance of frame j seen from frame i turned by `turn`, under everything the map knows.

    The exact marginal of the linearised problem, the bias included (it moves far frames together).
    """
    equations = _System(chain, closures, prior).linearise(fit)
    a, b = fit.poses[i], fit.poses[j]
    c, s = np.cos(a[2] + turn), np.sin(a[2] + turn)
    dx, dy = (b - a)[:2]
    by_i = np.array([[-c, -s, c * dy - s * dx], [s, -c, -c * dx - s * dy], [0, 0, -1.0]])
    by_j = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    change = np.zeros((len(fit.poses), 3, 3))
    change[i], change[j] = by_i.T, by_j.T
    return equations.covariance(change[1:])


def _tamed(chi2: np.ndarray, closures: LoopClosures) -> tuple[np.ndarray, np.ndarray]:
    """Weights of single closures, and their chi-squares [M] when none can cost more than `stray`: one that is
    astray must not take its sequence with it."""
    most = np.broadcast_to(closures.stray, closures.scale.shape)[closures.sequence]
    if not np.isfinite(most).all():
        return np.ones_like(chi2), chi2
    share = most / (most + chi2)
    return share**2, share * chi2


class _Equations(NamedTuple):
    """Normal equations of poses and bias: the factor of the poses' block, the rest bordering it; and where
    each free frame stands among the unknowns."""

    factor: SuperLU | None
    order: np.ndarray
    gradient: np.ndarray
    border: np.ndarray
    corner: float
    slope: float
    weights: np.ndarray

    def step(self) -> tuple[np.ndarray, float] | None:
        if self.factor is None:
            return None
        free, bent = self.factor.solve(np.stack([-self.gradient, self.border], axis=1)).T
        bias = (-self.slope - self.border @ free) / (self.corner - self.border @ bent)
        step = free - bias * bent
        if not np.isfinite(step).all():
            return None
        return np.concatenate([np.zeros((1, 3)), step.reshape(-1, 3)[self.order]]), float(bias)

    def covariance(self, change: np.ndarray) -> np.ndarray:
        """Of what changes by `change` [F, 3, n] with the poses of the free frames: [n, n]."""
        if self.factor is None:
            return np.full((change.shape[2],) * 2, np.inf)
        change = change[np.argsort(self.order)].reshape(-1, change.shape[2])
        spread = self.factor.solve(change)
        bent = self.factor.solve(self.border)
        pull = change.T @ bent
        return change.T @ spread + np.outer(pull, pull) / (self.corner - self.border @ bent)


class _System:
    """Where every block of the normal equations goes, worked out once for a set of edges."""

    def __init__(self, chain: OdometryChain, closures: LoopClosures, prior: BiasPrior) -> None:
        count, steps = len(chain.length) + 1, np.arange(len(chain.length))
        self.i, self.j = np.concatenate([steps, closures.i]), np.concatenate([steps + 1, closures.j])
        self.motion = np.concatenate([chain.motion, np.zeros((len(closures.i), 3))])
        self.motion[len(steps) :, 2] = closures.turn
        self.length = np.concatenate([chain.length, np.zeros(len(closures.i))])
        spread = np.broadcast_to(closures.variance, (len(closures.i), 3))
        self.information = 1 / np.concatenate([chain.variance, spread])
        self.closures, self.prior, self.chained = closures, prior, len(steps)
        self.members = np.bincount(closures.sequence, minlength=len(closures.scale))

        self.size = 3 * (count - 1)
        self.order = _order(self.i, self.j, count)
        ends = 3 * np.stack([self.order[self.i], self.order[self.j]], axis=1)[:, :, None]
        at = (ends + np.arange(3)).reshape(-1, 6)  # frame 0 is held: its rows are left out
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
        measured = correct_heading_bias(self.motion, self.length, fit.bias)
        ahead, aside = c * dx + s * dy, c * dy - s * dx
        error = np.stack(
            [ahead - measured[:, 0], aside - measured[:, 1], wrap(b[:, 2] - a[:, 2] - measured[:, 2])], 1
        )
        chi2 = (error**2 * self.information).sum(axis=1)
        keep, tamed = _tamed(chi2[self.chained :], self.closures)
        total = np.bincount(self.closures.sequence, tamed, len(self.members))
        mean = total / np.maximum(self.members, 1)
        weights = (self.closures.scale / (self.closures.scale + mean)) ** 2

        jacobian = np.zeros((len(a), 3, 6))
        jacobian[:, 0, :3] = np.stack([-c, -s, aside], axis=1)
        jacobian[:, 1, :3] = np.stack([s, -c, -ahead], axis=1)
        jacobian[:, 0, 3], jacobian[:, 0, 4], jacobian[:, 1, 3], jacobian[:, 1, 4] = c, s, -s, c
        jacobian[:, 2, 2], jacobian[:, 2, 5] = -1.0, 1.0
        by_bias = (
            np.stack([measured[:, 1] / 2, -measured[:, 0] / 2, -np.ones(len(a))], 1) * self.length[:, None]
        )

        trust = self.information.copy()
        trust[self.chained :] *= (keep * weights[self.closures.sequence])[:, None]
        weighted = np.swapaxes(jacobian, 1, 2) * trust[:, None, :]
        data = np.bincount(self.slot, (weighted @ jacobian)[self.used], self.count)
        pulled = weighted @ np.stack([error, by_bias], axis=2)
        gradient, border = (np.bincount(self.row, pulled[:, :, k][self.free], self.size) for k in (0, 1))
        matrix = csc_matrix((data, self.indices, self.indptr), (self.size, self.size))
        tight = 1 / self.prior.sd**2
        return _Equations(
            _factor(matrix),
            self.order[1:],
            gradient,
            border,
            float((by_bias**2 * trust).sum() + tight),
            float((by_bias * trust * error).sum() + tight * (fit.bias - self.prior.mean)),
            weights,
        )


def _order(i: np.ndarray, j: np.ndarray, count: int) -> np.ndarray:
    """[N] where frames stand among the unknowns for factors with few entries: of minimum degree, as SuperLU
    finds it, but for frames and once, not for their coordinates at every step. Frame 0 stands before all."""
    free = (i > 0) & (j > 0)
    i, j = i[free] - 1, j[free] - 1
    ends, size = np.arange(count - 1), count - 1
    ties = np.ones(len(i))
    # Only who is tied to whom matters; the diagonal keeps it from being singular.
    among = csc_matrix((ties, (i, j)), (size, size))
    degree = csc_matrix((np.full(size, 4.0 * len(i) + 1), (ends, ends)), (size, size))
    factor = _factored(among + among.T + degree, "MMD_AT_PLUS_A")
    return np.concatenate([[-1], factor.perm_c])


def _factor(matrix: csc_matrix) -> SuperLU | None:
    try:
        return _factored(matrix, "NATURAL")
    except RuntimeError:  # singular: a frame that nothing ties to frame 0
        return None


def _factored(matrix: csc_matrix, ordering: str) -> SuperLU:
    return splu(matrix, permc_spec=ordering, options={"SymmetricMode": True}, diag_pivot_thresh=0.0)
