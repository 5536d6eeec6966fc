"""Laws of the chain with closures in sequences, one heading bias and one turn error, by dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from ratslam.mapping.normal_equations import BlockPattern
from ratslam.mapping.optimizer import (
    CalibrationPrior,
    MapCovariance,
    MapFit,
    MapProblem,
    System,
    solve,
)
from tactile.base.se2 import between, compose, correct_heading, wrap
from tests.ratslam.mapping.optimizer_cases import (
    BOTH_WIDE,
    START,
    SURE,
    WIDE,
    apart,
    chained,
    closed,
    fit_of,
    from_odometry,
    laps,
    miscalibrated,
    parts,
    reckoned,
    residuals,
    robust_weights,
    slopes,
    unknowns,
)

PRIORS = CalibrationPrior(0.03, 0.02), CalibrationPrior(0.03, 0.02, -0.01, 0.04)
"""Of the bias alone, and with a turn error."""
priors = st.sampled_from(PRIORS)
seeds = st.integers(0, 1000)


@settings(max_examples=20)
@given(seeds, st.sampled_from([SURE, 3.0]), priors)
def test_a_step_is_gauss_newtons(seed, scale, prior):
    """By a dense least-squares solve of numerical derivatives."""
    stream = np.random.default_rng(seed)
    truth, chain, closures = laps(stream, 0.04, 8, 0.02, -0.05)
    closures = closures._replace(scale=np.full(3, scale))
    start = MapFit(truth + stream.normal(0, 0.03, truth.shape), 0.01, np.zeros(0), 0.02)
    weights, x = robust_weights(start, chain, closures), unknowns(start, prior)

    def errors(x):
        return residuals(x, start, chain, closures, prior, weights)

    step = np.linalg.lstsq(slopes(errors, x), -errors(x), rcond=None)[0]
    fit = solve(start, MapProblem(chain, closures, prior), 1)
    assert np.allclose(fit.weights, weights)
    assert np.allclose(wrap(unknowns(fit, prior) - x - step), 0, atol=1e-6)


@settings(max_examples=6)
@given(seeds, priors)
def test_without_robust_weights_it_is_least_squares(seed, prior):
    stream = np.random.default_rng(seed)
    _, chain, closures = laps(stream, 0.04, 8, 0.03)
    start = from_odometry(chain)
    fit = solve(start, MapProblem(chain, closures, prior), 50)
    rest = start, chain, closures, prior, np.ones(3)
    found = least_squares(residuals, unknowns(start, prior), args=rest, method="lm", xtol=1e-12)
    assert np.abs(wrap(found.x - unknowns(fit, prior))).max() < 1e-4
    cost = (residuals(unknowns(fit, prior), *rest) ** 2).sum()
    assert cost <= 2 * found.cost * (1 + 1e-6)


@pytest.mark.parametrize("bias", [0.06, -0.03])
@pytest.mark.parametrize(
    ("turn_error", "prior"), [(0.0, WIDE), (0.0, BOTH_WIDE), (0.2, BOTH_WIDE), (-0.1, BOTH_WIDE)]
)
def test_true_closures_determine_the_calibration_and_all_poses(bias, turn_error, prior):
    truth, chain, closures = laps(np.random.default_rng(0), bias, turn_error=turn_error)
    start = from_odometry(chain)
    assert apart(start.poses, truth) > 0.5
    fit = solve(start, MapProblem(chain, closures, prior), 30)
    assert apart(fit.poses, truth) < 1e-5
    assert fit.bias == pytest.approx(bias, abs=1e-6)
    assert fit.turn_error == pytest.approx(turn_error, abs=1e-6)
    assert np.allclose(fit.weights, 1)


@given(seeds)
@settings(max_examples=10)
def test_the_first_frame_never_moves(seed):
    stream = np.random.default_rng(seed)
    _, chain, closures = laps(stream, 0.05, noise=0.05)
    first = stream.uniform(-3, 3, 3)
    fit = solve(MapFit(reckoned(chain, first), 0.0, np.zeros(0)), MapProblem(chain, closures, WIDE), 10)
    assert np.allclose(fit.poses[0], first, rtol=0, atol=1e-14)
    assert apart(fit.poses, reckoned(chain, first)) > 0.1


def robust_case(seed, cost_limit, prior=PRIORS[0], count=8):
    """Laps with noise, a start that is off, and sequences of which the second is false."""
    stream = np.random.default_rng(seed)
    truth, chain, closures = laps(stream, 0.04, count, 0.02)
    turn = closures.turn + (closures.sequence == 1) * stream.uniform(-0.5, 0.5)
    closures = closures._replace(scale=stream.uniform(1, 20, 3), cost_limit=cost_limit, turn=turn)
    start = truth + stream.normal(0, 0.05, truth.shape)
    start[0] = truth[0]
    return MapFit(start, 0.0, np.zeros(3)), MapProblem(chain, closures, prior)


def cost_by_loops(fit, problem):
    chain, closures, prior, _ = problem
    odometry, recall = parts(fit, chain, closures)
    cost = (odometry**2).sum() + ((fit.bias - prior.bias) / prior.bias_sd) ** 2
    if prior.turn_error_sd:
        cost += ((fit.turn_error - prior.turn_error) / prior.turn_error_sd) ** 2
    for sequence, scale in enumerate(closures.scale):
        each = [(recall[k] ** 2).sum() for k in np.flatnonzero(closures.sequence == sequence)]
        if np.isfinite(closures.cost_limit):
            each = [closures.cost_limit * chi2 / (closures.cost_limit + chi2) for chi2 in each]
        mean = sum(each) / max(len(each), 1)
        cost += len(each) * scale * mean / (scale + mean)
    return cost


@given(seeds, st.sampled_from([np.inf, 6.0, 0.5]), priors)
def test_the_robust_cost_equals_explicit_loops(seed, cost_limit, prior):
    start, problem = robust_case(seed, cost_limit, prior)
    fit = start._replace(bias=0.01, turn_error=0.02)
    assert System(problem).robust_cost(fit) == pytest.approx(cost_by_loops(fit, problem), rel=1e-9)


@given(seeds, st.sampled_from([np.inf, 20.0, 6.0]), priors)
def test_every_step_lowers_the_robust_cost(seed, cost_limit, prior):
    fit, problem = robust_case(seed, cost_limit, prior)
    costs = [System(problem).robust_cost(fit)]
    for _ in range(15):
        fit = solve(fit, problem, 1)
        costs.append(System(problem).robust_cost(fit))
        assert np.allclose(fit.poses[0], START, rtol=0, atol=1e-12)  # the first frame never moves
    assert (np.diff(costs) <= 1e-9 * np.array(costs[:-1])).all()
    assert costs[-1] < 0.5 * costs[0]


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("cost_limit", [np.inf, 6.0, 1.0])
def test_the_solution_has_the_least_robust_cost(cost_limit, prior):
    start, problem = robust_case(3, cost_limit, prior)
    fit = solve(start, problem, 500)
    assert ((fit.weights > 0.01) & (fit.weights < 0.999)).any()
    least, x = System(problem).robust_cost(fit), unknowns(fit, prior)
    for step in 1e-3 * np.eye(len(x)):
        for sign in (1, -1):
            assert System(problem).robust_cost(fit_of(x + sign * step, fit, prior)) > least


def test_a_coarser_tolerance_takes_fewer_steps():
    start, problem = robust_case(0, 6.0)
    fine = solve(start, problem, 100, 1e-9)
    for tolerance in (1e-3, 1e-5):
        coarse = solve(start, problem, 100, tolerance)
        assert 0 < apart(coarse.poses, fine.poses) < 100 * tolerance
    assert np.array_equal(solve(start, problem, 1, 1e-9).poses, solve(start, problem, 100, 1e3).poses)


@pytest.mark.parametrize("seed", range(3))
def test_no_step_raises_the_cost(seed):
    """A closure that turns a long chain by radians, where a whole Gauss-Newton step would."""
    stream = np.random.default_rng(seed)
    motion = np.zeros((300, 3))
    motion[:, 0], motion[:, 2] = 0.1, stream.normal(0, 0.3, 300)
    chain = chained(motion)
    closures = closed([(3 + k, 296 + k) for k in range(4)], [2.0] * 4, [0] * 4, [20.0])
    system = System(MapProblem(chain, closures, PRIORS[1]))
    fit = from_odometry(chain)
    costs = [system.robust_cost(fit)]
    for _ in range(8):
        fit = system.solve(fit, 1)
        costs.append(system.robust_cost(fit))
    assert np.diff(costs).max() <= 1e-6 * costs[0]


@given(st.floats(0, 5), st.floats(-0.2, 0.2), st.floats(-0.3, 0.3), seeds)
def test_a_turn_error_is_a_share_of_the_turn(length, bias, turn_error, seed):
    """The correction undoes the miscalibration, and a bias and a turn error add up."""
    motion = np.random.default_rng(seed).uniform(-1, 1, (1, 3))
    measured = miscalibrated(motion, np.array([length]), bias, turn_error)
    assert np.allclose(correct_heading(measured, length, bias, turn_error), motion, atol=1e-12)
    both = correct_heading(motion, length, bias, turn_error)
    as_bias = correct_heading(motion, 1.0, bias * length + turn_error * motion[0, 2])
    assert np.allclose(both, as_bias, atol=1e-12)
    straight = motion * [1, 1, 0]
    assert np.allclose(correct_heading(straight, 1.0, 0.0, turn_error), straight, atol=1e-12)


@settings(max_examples=10)
@given(seeds, st.sampled_from([1e12, 5.0]))
def test_without_a_turn_error_all_is_as_with_the_bias_alone(seed, scale):
    """A standard deviation of zero fixes the turn error, whatever its value is."""
    stream = np.random.default_rng(seed)
    _, chain, closures = laps(stream, 0.04, 12, 0.02)
    closures = closures._replace(scale=np.full(3, scale))
    alone = MapProblem(chain, closures, CalibrationPrior(0.01, 0.02))
    fixed = alone._replace(prior=CalibrationPrior(0.01, 0.02, 0.3, 0.0))
    start = from_odometry(chain, 0.01)
    fits = [solve(start, problem, 10) for problem in (alone, fixed)]
    assert np.array_equal(fits[0].poses, fits[1].poses)
    assert [fit[1:2] + fit[3:] for fit in fits] == [(fits[0].bias, 0.0)] * 2
    # Odometry whose turns were corrected beforehand by a turn error that is then held.
    before = miscalibrated(chain.motion, 0 * chain.length, 0.0, 0.1)
    held = solve(start._replace(turn_error=0.1), fixed._replace(chain=chain._replace(motion=before)), 10)
    assert held.turn_error == 0.1
    assert apart(held.poses, fits[0].poses) < 1e-9
    nearly = alone._replace(prior=CalibrationPrior(0.01, 0.02, 0.0, 1e-9))
    near = solve(start, nearly, 10)
    assert apart(near.poses, fits[0].poses) < 1e-9
    pair = 3, len(chain.length), 0.2
    covariances = [MapCovariance(near, each).relative(*pair) for each in (alone, fixed, nearly)]
    assert np.array_equal(covariances[0], covariances[1])
    assert np.allclose(covariances[0], covariances[2], rtol=1e-6, atol=1e-12)


@given(seeds, st.sampled_from([CalibrationPrior(0.0, 0.05), CalibrationPrior(0.0, 0.05, 0.02, 0.1)]))
@settings(max_examples=20)
def test_relative_covariance_is_the_marginal_of_the_whole_information(seed, prior):
    stream = np.random.default_rng(seed)
    truth, chain, closures = laps(stream, 0.02, 6, 0.02)
    closures = closures._replace(scale=np.array([2.0, 5.0, 20.0]))
    fit = MapFit(truth + stream.normal(0, 0.02, truth.shape), 0.01, np.zeros(3), 0.03)
    i, j = stream.choice(len(truth), 2, replace=False).tolist()
    turn = stream.uniform(-3, 3)
    weights, x = robust_weights(fit, chain, closures), unknowns(fit, prior)
    jacobian = slopes(lambda x: residuals(x, fit, chain, closures, prior, weights), x)

    def seen(x):
        poses = fit_of(x, fit, prior).poses
        # Unwrapped, so that the derivative has no jump.
        return np.append(
            between(compose(poses[i], np.array([0, 0, turn])), poses[j])[:2], poses[j, 2] - poses[i, 2]
        )

    by = slopes(seen, x)
    expected = by @ np.linalg.inv(jacobian.T @ jacobian) @ by.T
    covariance = MapCovariance(fit, MapProblem(chain, closures, prior)).relative(i, j, turn)
    assert np.allclose(covariance, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_an_unconnected_frame_leaves_the_map_unchanged():
    chain = chained(np.tile([0.5, 0.0, 0.1], (4, 1)))
    chain.variance[-1] = np.inf
    start = reckoned(chain) + 0.01
    fit = solve(MapFit(start, 0.01, np.zeros(0)), MapProblem(chain, closed([]), WIDE), 5)
    assert np.array_equal(fit.poses, start)
    assert fit.bias == 0.01
    assert np.isinf(MapCovariance(fit, MapProblem(chain, closed([]), WIDE)).relative(0, 4, 0.0)).all()


counts = st.integers(1, 25)


def graph(stream, count):
    """A chain of nodes with edges between random ones, some of them twice."""
    a = np.arange(count - 1)
    pairs = stream.integers(0, count, (count, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    return np.concatenate([a, pairs[:, 0], pairs[:, 1]]), np.concatenate([a + 1, pairs[:, 1], pairs[:, 0]])


def matrix(stream, pattern, a, b, damping=1.0):
    """A positive definite matrix on a graph: the blocks in the order of elimination, and the dense one in
    the order of the nodes."""
    count = pattern.count
    jacobian = stream.normal(size=(len(a), 3, 6))
    each = np.swapaxes(jacobian, 1, 2) @ jacobian
    diagonal = np.tile(damping * np.eye(3), (count, 1, 1))
    above, dense = np.zeros((len(pattern.row), 3, 3)), np.zeros((count, 3, count, 3))
    dense[np.arange(count), :, np.arange(count)] = diagonal
    for i, j, slot, block in zip(a, b, pattern.slot, each, strict=True):
        diagonal[pattern.place[i]] += block[:3, :3]
        diagonal[pattern.place[j]] += block[3:, 3:]
        cross = block[:3, 3:]
        above[slot] += cross if pattern.place[i] < pattern.place[j] else cross.T
        dense[i, :, i] += block[:3, :3]
        dense[j, :, j] += block[3:, 3:]
        dense[i, :, j] += cross
        dense[j, :, i] += cross.T
    return diagonal, above, dense.reshape(3 * count, 3 * count)


@given(seeds, counts, st.integers(1, 4))
def test_solutions_and_determinant_are_those_of_the_dense_matrix(seed, count, columns):
    stream = np.random.default_rng(seed)
    a, b = graph(stream, count)
    pattern = BlockPattern(count, a, b)
    diagonal, above, dense = matrix(stream, pattern, a, b)
    factor = pattern.factorise(diagonal, above)
    right = stream.normal(size=(count, 3, columns))
    solution = factor.solve(right[np.argsort(pattern.place)])[pattern.place]
    expected = np.linalg.solve(dense, right.reshape(3 * count, columns))
    assert np.allclose(solution.reshape(expected.shape), expected, rtol=1e-7, atol=1e-9)
    assert factor.log_determinant == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-9)


@given(seeds, counts)
def test_a_matrix_that_is_not_positive_definite_has_no_factor(seed, count):
    stream = np.random.default_rng(seed)
    a, b = graph(stream, count)
    pattern = BlockPattern(count, a, b)
    diagonal, above, dense = matrix(stream, pattern, a, b)
    node = int(stream.integers(count))
    diagonal[pattern.place[node]] -= 2 * np.linalg.eigvalsh(dense)[-1] * np.eye(3)
    assert pattern.factorise(diagonal, above) is None
    assert pattern.factorise(np.zeros_like(diagonal), np.zeros_like(above)) is None


def test_a_graph_without_nodes_has_an_empty_solution():
    none = np.zeros(0, int)
    factor = BlockPattern(0, none, none).factorise(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)))
    assert factor.solve(np.zeros((0, 3, 2))).shape == (0, 3, 2)
    assert factor.log_determinant == 0.0
