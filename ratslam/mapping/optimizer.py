"""Robust SE(2) least squares over a chain of keyframes with closure sequences and the odometry's calibration.

A constant turn of the odometry to one side, the heading bias (rad/m), and the share by which its turns are
wrong, the turn error (rad/rad), are solved for with the poses. Each closure sequence has one robust weight,
because its closures are right or wrong together. Keyframe 0 is fixed.

With errors e and information W of odometry, links and calibration prior, and of each sequence s its number
of closures n, mean chi-square c and scale mu, the cost is sum e' W e + sum over s of n mu c / (mu + c). The
error of a measurement is that of Kuemmerle et al. 2011 (g2o), the kernel that of Geman & McClure 1985.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import NamedTuple

import numpy as np

from ratslam.mapping.normal_equations import (
    BlockPattern,
    Equations,
    add_measurements,
    measurement_errors,
    weigh_closures,
)
from tactile.base.se2 import bend_motion, between, correct_heading, wrap

HALVINGS = 10
"""Number of lengths tried of a step."""
LOOSE = 1e4
"""Standard deviation of odometry across a break, cells and rad; while cuts are tried, m and rad."""
ROUNDING = 1e-9
"""Share by which rounding may raise the cost of a solved map."""


class OdometryChain(NamedTuple):
    """Odometry between consecutive keyframes.

    Attributes:
        motion: [N - 1, 3] pose of the later keyframe in the frame of the earlier one (m, m, rad).
        length: [N - 1] distance travelled, m. variance: [N - 1, 3] of the motion.
    """

    motion: np.ndarray
    length: np.ndarray
    variance: np.ndarray


class OdometryLinks(NamedTuple):
    """Odometry between keyframes that became neighbours when others were merged.

    Attributes:
        i, j: [L] keyframes. motion: [L, 3] pose of keyframe j in the frame of keyframe i (m, m, rad).
            length: [L] distance travelled, m. turn: [L] turn by odometry within it, rad.
            variance: [L, 3] of the motion.
    """

    i: np.ndarray
    j: np.ndarray
    motion: np.ndarray
    length: np.ndarray
    turn: np.ndarray
    variance: np.ndarray


NO_LINKS = OdometryLinks(
    np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)), np.zeros(0), np.zeros(0), np.zeros((0, 3))
)


class LoopClosures(NamedTuple):
    """Loop closures: keyframe j has the position of keyframe i, and its heading plus `turn`.

    Attributes:
        i, j: [M] keyframes. turn: [M] rad. sequence: [M] the sequence of each, 0..R - 1. variance: [3] of
            each. scale: [R] mean chi-square at which the weight of a sequence is a quarter. score, size:
            [R] evidence and number of closures, those of merged keyframes included. credit: [R] share of
            that evidence that counts. cost_limit: largest chi-square of one closure, [R] by sequence or one
            for all.
    """

    i: np.ndarray
    j: np.ndarray
    turn: np.ndarray
    sequence: np.ndarray
    variance: np.ndarray
    scale: np.ndarray
    score: np.ndarray = np.zeros(0)
    size: np.ndarray = np.zeros(0)
    credit: np.ndarray = np.zeros(0)
    cost_limit: np.ndarray | float = np.inf

    def of_sequences(self, sequences: np.ndarray) -> LoopClosures:
        """The closures of the sequences marked in [R] bool."""
        rows = sequences[self.sequence]
        number = np.cumsum(sequences) - 1
        return self._replace(
            i=self.i[rows],
            j=self.j[rows],
            turn=self.turn[rows],
            sequence=number[self.sequence[rows]],
            scale=self.scale[sequences],
            cost_limit=np.broadcast_to(self.cost_limit, self.scale.shape)[sequences],
        )


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
    links: OdometryLinks = NO_LINKS

    def with_heading_noise(self, factor: float) -> MapProblem:
        """The problem with the variances of the odometry's headings times `factor`."""
        by = np.array([1.0, 1.0, factor])
        chain = self.chain._replace(variance=self.chain.variance * by)
        return self._replace(chain=chain, links=self.links._replace(variance=self.links.variance * by))

    def cut_at(self, frames: Sequence[int] | np.ndarray) -> MapProblem:
        """The problem with loose odometry before keyframes [n]."""
        if not len(frames):
            return self
        variance = self.chain.variance.copy()
        variance[[frame - 1 for frame in frames]] = LOOSE**2
        return self._replace(chain=self.chain._replace(variance=variance))


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

    def strain(self, chain: OdometryChain) -> np.ndarray:
        """[N - 1] chi-squares of the chain."""
        error = between(self.poses[:-1], self.poses[1:]) - self.corrected(chain)
        error[:, 2] = wrap(error[:, 2])
        return (error**2 / chain.variance).sum(axis=1)

    def corrected_links(self, links: OdometryLinks) -> np.ndarray:
        """[L, 3] the motions of links without their systematic errors."""
        return bend_motion(links.motion, self.bias * links.length + self.turn_error * links.turn)


def solve(start: MapFit, problem: MapProblem, iterations: int, tolerance: float = 1e-4) -> MapFit:
    """Gauss-Newton with one robust weight per sequence (iteratively reweighted least squares).

    Args:
        start: poses and calibration from which the search begins; its weights are not used.
        problem: odometry, closures, links and the prior of the calibration.
        iterations: largest number of steps.
        tolerance: largest change of a pose at convergence, m and rad.

    Returns:
        the fit after the first step that changes every pose by less than the tolerance (m, rad), or after
        `iterations` steps; the last fit before the equations become singular. Steps that together raise the
        cost are taken anew, each halved until it does not: a closure that turns a long chain by radians
        moves its end along an arc, and the tangent can lead far away (Nocedal & Wright 2006, section 3.1).
    """
    return System(problem).solve(start, iterations, tolerance)


Advance = Callable[[MapFit, np.ndarray, np.ndarray], tuple[MapFit, float]]
"""The fit after a share of a step of the poses [N, 3] and of the calibration [K], and that share."""


def _whole_step(fit: MapFit, poses: np.ndarray, calibration: np.ndarray) -> tuple[MapFit, float]:
    moved = fit.poses + poses
    moved[:, 2] = wrap(moved[:, 2])
    bias, turn_error = fit.bias + calibration[0], fit.turn_error + sum(calibration[1:])
    return fit._replace(poses=moved, bias=float(bias), turn_error=float(turn_error)), 1.0


def _calibration(fit: MapFit, prior: CalibrationPrior) -> tuple[np.ndarray, np.ndarray]:
    """[K] deviation of the free calibration parameters from their prior, and its information."""
    off = [fit.bias - prior.bias, fit.turn_error - prior.turn_error]
    sd = np.array([prior.bias_sd, prior.turn_error_sd])
    free = 1 + int(sd[1] > 0)
    return np.array(off[:free]), 1 / sd[:free] ** 2


class MapCovariance:
    """The exact marginals of the linearised problem, the calibration included: it moves distant keyframes
    together. Columns of the inverse are solved for as they are asked for (Kaess & Dellaert 2009)."""

    def __init__(self, fit: MapFit, problem: MapProblem) -> None:
        self._poses, self._equations = fit.poses, System(problem).linearise(fit)
        self._bent, self._calibrated = self._equations.bent()

    def calibration_sd(self) -> tuple[float, float]:
        """Standard deviations of heading bias, rad/m, and turn error, rad/rad (0 where it is fixed)."""
        if self._equations.factor is None:
            return np.inf, np.inf if len(self._calibrated) > 1 else 0.0
        sd = np.sqrt(np.diag(np.linalg.inv(self._calibrated)))
        return float(sd[0]), float(sd[1]) if len(sd) > 1 else 0.0

    def relative(self, i: int, j: int, turn: float) -> np.ndarray:
        """[3, 3] covariance of keyframe j in the frame of keyframe i turned by `turn`."""
        factor = self._equations.factor
        if factor is None:
            return np.full((3, 3), np.inf)
        a, b = self._poses[i], self._poses[j]
        c, s = np.cos(a[2] + turn), np.sin(a[2] + turn)
        dx, dy = (b - a)[:2]
        by_i = np.array([[-c, -s, c * dy - s * dx], [s, -c, -c * dx - s * dy], [0, 0, -1.0]])
        by_j = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        free = [(self._equations.place[k - 1], by) for k, by in ((i, by_i), (j, by_j)) if k > 0]
        right = np.zeros((len(self._bent), 3, 3))
        for at, by in free:
            right[at] += by.T
        spread, none = factor.solve(right), np.zeros((3, 3))
        pull = sum((by @ self._bent[at] for at, by in free), none[:, : len(self._calibrated)])
        shared = pull @ np.linalg.solve(self._calibrated, pull.T)
        return sum((by @ spread[at] for at, by in free), none) + shared


class System:
    """The linear equations of a problem; their sparsity pattern is computed once.

    The variances, robust scales and prior may be replaced (`with_problem`), the closures may not."""

    def __init__(self, problem: MapProblem) -> None:
        chain, closures, _, links = problem
        steps = np.arange(len(chain.length))
        i = np.concatenate([steps, links.i, closures.i])
        j = np.concatenate([steps + 1, links.j, closures.j])
        free = (i > 0) & (j > 0)
        self._pattern = BlockPattern(len(chain.length), i[free] - 1, j[free] - 1)
        place, slot = np.concatenate([[-1], self._pattern.place]), np.full(len(i), -1)
        slot[free] = self._pattern.slot
        self._ends = i, j, place[i], place[j], slot
        self._members = np.bincount(closures.sequence, minlength=len(closures.scale))
        self._set(problem)

    def with_problem(self, problem: MapProblem) -> System:
        """The equations of a problem with the same edges."""
        other = copy(self)
        other._set(problem)
        return other

    def _set(self, problem: MapProblem) -> None:
        chain, closures, prior, links = problem
        i, j, at_i, at_j, slot = self._ends
        none = np.zeros(len(closures.i))
        lengths = np.concatenate([chain.length, links.length, none])
        turns = np.concatenate([chain.motion[:, 2], links.turn, none])
        turned = np.column_stack([none, none, closures.turn])
        motion = np.concatenate([chain.motion, links.motion, turned])
        spread = np.broadcast_to(closures.variance, (len(closures.i), 3))
        information = 1 / np.concatenate([chain.variance, links.variance, spread])
        regressors = np.column_stack([lengths, turns])
        self._edges = i, j, motion, information, regressors, at_i, at_j, slot
        limit = np.broadcast_to(np.asarray(closures.cost_limit, float), closures.scale.shape)
        self._closures = len(chain.length) + len(links.length), closures.sequence, closures.scale, limit
        self._parameters, self._problem = 1 + int(prior.turn_error_sd > 0), problem

    def solve(self, start: MapFit, iterations: int, tolerance: float = 1e-4) -> MapFit:
        """See `solve`."""
        weights = np.ones(len(self._problem.closures.scale))
        first = MapFit(np.array(start.poses, float), start.bias, weights, start.turn_error)
        fit = self._iterate(first, iterations, tolerance, _whole_step)
        if self.robust_cost(fit) <= self.robust_cost(first) * (1 + ROUNDING):
            return fit
        return self._iterate(first, iterations, tolerance, self._descend)

    def _iterate(self, fit: MapFit, iterations: int, tolerance: float, advance: Advance) -> MapFit:
        for _ in range(iterations):
            equations = self.linearise(fit)
            fit = fit._replace(weights=equations.weights)
            step = equations.step()
            if step is None:
                break
            fit, share = advance(fit, *step)
            if share * np.abs(step[0]).max(initial=0.0) < tolerance:
                break
        return fit

    def _descend(self, fit: MapFit, poses: np.ndarray, calibration: np.ndarray) -> tuple[MapFit, float]:
        """The fit after a Gauss-Newton step, halved until it does not raise the robust cost, and the share
        of the step; the same fit and 0 where no halving helps."""
        cost = self.robust_cost(fit)
        for halvings in range(HALVINGS):
            share = 0.5**halvings
            after, _ = _whole_step(fit, share * poses, share * calibration)
            if self.robust_cost(after) <= cost:
                return after, share
        return fit, 0.0

    def robust_cost(self, fit: MapFit) -> float:
        """The cost that `solve` minimises: chi-square of odometry and calibration and robust cost of
        closures."""
        scale, chained = self._problem.closures.scale, self._closures[0]
        _, _, chi2 = self._errors(fit)
        _, _, mean = weigh_closures(chi2, *self._closures)
        lost = self._members * scale * mean / (scale + mean)
        off, tight = _calibration(fit, self._problem.prior)
        return float(chi2[:chained].sum() + lost.sum() + (tight * off**2).sum())

    def log_evidence(self, fit: MapFit) -> float:
        """Log probability of odometry and closures with poses and calibration integrated out, to second
        order around a fit that solves the problem (Laplace's method); up to a constant that does not depend
        on the variances of the odometry. -inf where the equations are singular."""
        information = self.linearise(fit).log_determinant()
        measured = self._problem.chain.variance, self._problem.links.variance
        spread = sum(float(np.log(variance).sum()) for variance in measured)
        return -0.5 * (self.robust_cost(fit) + information + spread)

    def linearise(self, fit: MapFit) -> Equations:
        poses = np.ascontiguousarray(fit.poses)
        measured, error, chi2 = self._errors(fit)
        trust, weights, _ = weigh_closures(chi2, *self._closures)
        pattern, parameters = self._pattern, self._parameters
        shapes = (pattern.count, 3, 3), (len(pattern.row), 3, 3), (pattern.count, 3, 1 + parameters)
        diagonal, above, right = (np.zeros(shape) for shape in shapes)
        corner, slope = np.zeros((parameters, parameters)), np.zeros(parameters)
        add_measurements(self._edges, poses, measured, error, trust, (diagonal, above, right, corner, slope))
        off, tight = _calibration(fit, self._problem.prior)
        factor, corner = pattern.factorise(diagonal, above), corner + np.diag(tight)
        return Equations(factor, pattern.place, right, corner, slope + tight * off, weights)

    def _errors(self, fit: MapFit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `measurement_errors`."""
        poses = np.ascontiguousarray(fit.poses)
        return measurement_errors(self._edges, poses, float(fit.bias), float(fit.turn_error))
