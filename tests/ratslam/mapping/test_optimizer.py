"""Laws of the chain with closures in sequences, one heading bias and one turn error."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from ratslam.mapping.optimizer import CalibrationPrior, LoopClosures, MapFit, MapProblem, System, solve
from tactile.base.se2 import wrap
from tests.ratslam.mapping.optimizer_cases import (
    BOTH_WIDE,
    CLOSURE,
    START,
    SURE,
    WIDE,
    apart,
    chained,
    closed,
    fit_of,
    from_odometry,
    laps,
    parts,
    reckoned,
    residuals,
    robust_weights,
    sequence_means,
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


@pytest.mark.parametrize("prior", [WIDE, BOTH_WIDE])
def test_robust_weights_are_geman_mcclure_by_sequence(prior):
    stream = np.random.default_rng(3)
    _, chain, closures = laps(stream, 0.04, 8, 0.02)
    # One sequence is moderately off, so that its weight, between 0 and 1, determines the optimum.
    closures = closures._replace(scale=np.full(3, 4.0), turn=closures.turn + 0.03 * (closures.sequence == 1))
    fit = solve(from_odometry(chain, 0.04), MapProblem(chain, closures, prior), 500)
    assert ((fit.weights > 0.1) & (fit.weights < 0.999)).any()

    def cost(x):
        tried = fit_of(x, fit, prior)
        odometry, recall = parts(tried, chain, closures)
        mean, members = sequence_means(recall, closures), np.bincount(closures.sequence)
        kernel = (members * closures.scale * mean / (closures.scale + mean)).sum()
        return (odometry**2).sum() + kernel + (tried.bias / 10) ** 2 + (tried.turn_error / 10) ** 2

    x = unknowns(fit, prior)
    for step in 1e-3 * np.eye(len(x)):
        assert min(cost(x + step), cost(x - step)) > cost(x)


@pytest.mark.parametrize("bias", [0.0, 0.03])
def test_a_sequence_far_off_has_no_effect(bias):
    stream = np.random.default_rng(1)
    _, chain, closures = laps(stream, bias, noise=0.01)
    closures = closures._replace(scale=np.full(3, 10.0))
    right = solve(from_odometry(chain, bias), MapProblem(chain, closures, WIDE), 50)
    false = closed([(k, k + 12) for k in range(2, 8)], np.zeros(6), np.full(6, 3), [10.0])
    both = LoopClosures(
        *(np.concatenate([a, b]) for a, b in zip(closures[:4], false[:4], strict=True)),
        CLOSURE,
        np.full(4, 10.0),
    )
    fit = solve(from_odometry(chain, bias), MapProblem(chain, both, WIDE), 50)
    assert fit.weights[3] < 1e-4
    assert fit.weights[:3].min() > 0.5
    assert np.allclose(fit.weights[:3], right.weights, atol=0.01)
    assert apart(fit.poses, right.poses) < 5e-3
    trusting = solve(
        from_odometry(chain, bias), MapProblem(chain, both._replace(scale=np.full(4, SURE)), WIDE), 50
    )
    assert apart(trusting.poses, right.poses) > 0.3


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


def test_the_robust_cost_of_a_perfect_map_is_zero():
    truth, chain, closures = laps(np.random.default_rng(0), 0.03, turn_error=0.02)
    fit = MapFit(truth, 0.03, np.zeros(3), 0.02)
    sure = CalibrationPrior(0.03, 1.0, 0.02, 1.0)
    assert System(MapProblem(chain, closures, sure)).robust_cost(fit) < 1e-12
    off = CalibrationPrior(0.02, 0.01, 0.08, 0.03)
    assert System(MapProblem(chain, closed([]), off)).robust_cost(fit) == pytest.approx(1.0 + 4.0)


@given(seeds, st.sampled_from([np.inf, 20.0, 6.0]), priors)
@settings(max_examples=60)
def test_every_step_lowers_the_robust_cost(seed, cost_limit, prior):
    fit, problem = robust_case(seed, cost_limit, prior)
    costs = [System(problem).robust_cost(fit)]
    for _ in range(25):
        fit = solve(fit, problem, 1)
        costs.append(System(problem).robust_cost(fit))
    assert (np.diff(costs) <= 1e-9 * np.array(costs[:-1])).all()
    assert costs[-1] < 0.5 * costs[0]


@pytest.mark.parametrize("prior", PRIORS)
@pytest.mark.parametrize("cost_limit", [6.0, 1.0])
def test_the_solution_has_the_least_robust_cost(cost_limit, prior):
    start, problem = robust_case(3, cost_limit, prior)
    fit = solve(start, problem, 500)
    assert ((fit.weights > 0.01) & (fit.weights < 0.999)).any()
    least, x = System(problem).robust_cost(fit), unknowns(fit, prior)
    for step in 1e-3 * np.eye(len(x)):
        for sign in (1, -1):
            assert System(problem).robust_cost(fit_of(x + sign * step, fit, prior)) > least


def test_one_false_closure_does_not_cost_its_sequence():
    truth, chain, closures = laps(np.random.default_rng(1), 0.0, noise=0.005)
    closures = closures._replace(scale=np.full(3, 4.0))
    astray = closures._replace(i=np.where(np.arange(len(closures.i)) == 5, 20, closures.i))
    strict = solve(from_odometry(chain), MapProblem(chain, astray, WIDE), 50)
    lenient = solve(from_odometry(chain), MapProblem(chain, astray._replace(cost_limit=6.0), WIDE), 50)
    sequence = closures.sequence[5]
    assert strict.weights[sequence] < 0.01
    assert lenient.weights[sequence] > 0.25
    assert apart(lenient.poses, truth) < 0.1


def test_a_coarser_tolerance_takes_fewer_steps():
    start, problem = robust_case(0, 6.0)
    fine = solve(start, problem, 100, 1e-9)
    for tolerance in (1e-3, 1e-5):
        coarse = solve(start, problem, 100, tolerance)
        assert 0 < apart(coarse.poses, fine.poses) < 100 * tolerance
    assert np.array_equal(solve(start, problem, 1, 1e-9).poses, solve(start, problem, 100, 1e3).poses)


@given(seeds)
@settings(max_examples=10)
def test_the_first_frame_never_moves(seed):
    stream = np.random.default_rng(seed)
    _, chain, closures = laps(stream, 0.05, noise=0.05)
    first = stream.uniform(-3, 3, 3)
    fit = solve(MapFit(reckoned(chain, first), 0.0, np.zeros(0)), MapProblem(chain, closures, WIDE), 10)
    assert np.allclose(fit.poses[0], first, rtol=0, atol=1e-14)
    assert apart(fit.poses, reckoned(chain, first)) > 0.1


def test_a_single_frame_is_a_map():
    chain = chained(np.zeros((0, 3)))
    fit = solve(
        MapFit(START[None], 0.01, np.zeros(0)), MapProblem(chain, closed([]), CalibrationPrior(0.03, 0.01)), 5
    )
    assert np.allclose(fit.poses, START[None], rtol=0, atol=1e-14)
    assert np.isfinite(fit.bias)


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
