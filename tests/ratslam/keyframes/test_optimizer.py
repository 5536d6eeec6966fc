"""Laws of the chain with closures in sequences and one heading bias."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from ratslam.keyframes.optimizer import (
    BiasPrior,
    LoopClosures,
    MapCovariance,
    MapFit,
    MapProblem,
    OdometryChain,
    robust_cost,
    solve,
)
from tactile.base.se2 import between, compose, correct_heading_bias, integrate, wrap

WIDE = BiasPrior(0.0, 10.0)
SURE = 1e12  # robust scale at which no sequence loses weight
CLOSURE = np.array([0.02, 0.02, 0.01]) ** 2
START = np.array([2.0, -1.0, 3.0])  # not the origin, and near the wrap of angles
seeds = st.integers(0, 1000)


def chained(motion, sd=(0.02, 0.02, 0.01)):
    return OdometryChain(
        motion, np.hypot(motion[:, 0], motion[:, 1]), np.tile(np.square(sd), (len(motion), 1))
    )


def closed(pairs, turn=(), sequence=(), scale=()):
    i, j = np.array(pairs, int).reshape(-1, 2).T
    return LoopClosures(i, j, np.array(turn, float), np.array(sequence, int), CLOSURE, np.array(scale, float))


def laps(stream, bias=0.0, count=24, noise=0.0):
    """Two laps of an ellipse, the second seen turned: truth, odometry, true closures in 3 sequences."""
    at = 2 * np.pi * np.arange(2 * count) / count
    truth = np.stack([3 * np.cos(at), 2 * np.sin(at), wrap(at + np.pi / 2)], axis=1)
    turn = np.where(np.arange(2 * count) < count, 0.0, stream.uniform(-0.6, 0.6, 2 * count))
    truth = compose(truth, np.stack([0 * turn, 0 * turn, turn], axis=1))
    truth = compose(compose(START, between(truth[0], np.zeros(3))), truth)
    motion = between(truth[:-1], truth[1:])
    chain = chained(correct_heading_bias(motion, np.hypot(motion[:, 0], motion[:, 1]), -bias))
    chain = chain._replace(motion=chain.motion + noise * stream.normal(0, 1, motion.shape) * [1, 1, 0.5])
    i = np.arange(1, count, 2)
    sequence = np.arange(len(i)) * 3 // len(i)
    return truth, chain, closed(np.stack([i, i + count], 1), turn[i + count], sequence, [SURE] * 3)


def reckoned(chain, start=START):
    return np.vstack([start, integrate(chain.motion, start)])


def parts(poses, bias, chain, closures):
    """Whitened residuals of the chain and of the closures, from the keyframes alone."""
    odometry = between(poses[:-1], poses[1:]) - correct_heading_bias(chain.motion, chain.length, bias)
    recall = between(poses[closures.i], poses[closures.j])
    recall[:, 2] -= closures.turn
    for error in (odometry, recall):
        error[:, 2] = wrap(error[:, 2])
    return odometry / np.sqrt(chain.variance), recall / np.sqrt(closures.variance)


def sequence_means(recall, closures):
    sequences = range(len(closures.scale))
    return np.array([(recall[closures.sequence == k] ** 2).sum(axis=1).mean() for k in sequences])


def unknowns(poses, bias):
    return np.append(poses[1:].ravel(), bias)


def residuals(x, first, chain, closures, prior, weights):
    poses = np.vstack([first, x[:-1].reshape(-1, 3)])
    odometry, recall = parts(poses, x[-1], chain, closures)
    recall = recall * np.sqrt(weights)[closures.sequence][:, None]
    return np.concatenate([odometry.ravel(), recall.ravel(), [(x[-1] - prior.mean) / prior.sd]])


def slopes(function, x, h=1e-6):
    return np.stack([(function(x + e) - function(x - e)) / (2 * h) for e in h * np.eye(len(x))], axis=1)


def apart(a, b):
    gap = a - b
    gap[:, 2] = wrap(gap[:, 2])
    return np.abs(gap).max()


@given(
    st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3.1, 3.1)), st.floats(0, 5), st.floats(-0.2, 0.2)
)
def test_opposite_corrections_cancel_and_zero_changes_nothing(motion, length, bias):
    motion = np.array(motion)
    assert np.allclose(correct_heading_bias(motion, length, 0.0), motion, atol=1e-12)
    there = correct_heading_bias(motion, length, bias)
    assert abs(wrap(there[2] - motion[2] - bias * length)) < 1e-12
    assert np.allclose(correct_heading_bias(there, length, -bias), motion, atol=1e-12)


@given(st.floats(0.5, 4), st.floats(-0.05, 0.05))
def test_a_bias_accumulates_evenly(length, bias):
    straight = np.array([length, 0.0, 0.0])
    whole, half = (
        correct_heading_bias(straight, length, bias),
        correct_heading_bias(straight / 2, length / 2, bias),
    )
    gap = between(whole, compose(half, half))
    assert abs(gap[2]) < 1e-12
    # The chord replaces the arc: an error of second order in the turn; a one-sided rule has first order.
    assert np.hypot(*gap[:2]) < length * (bias * length) ** 2 / 30 + 1e-12


@pytest.mark.parametrize("bias", [0.06, -0.03])
def test_true_closures_determine_the_bias_and_all_poses(bias):
    truth, chain, closures = laps(np.random.default_rng(0), bias)
    start = reckoned(chain)
    assert apart(start, truth) > 0.5
    fit = solve(MapFit(start, 0.0, np.zeros(0)), MapProblem(chain, closures, WIDE), 30)
    assert apart(fit.poses, truth) < 1e-5
    assert fit.bias == pytest.approx(bias, abs=1e-6)
    assert np.allclose(fit.weights, 1)


def test_a_certain_prior_holds_the_bias():
    truth, chain, closures = laps(np.random.default_rng(0), 0.05)
    fit = solve(
        MapFit(reckoned(chain), 0.0, np.zeros(0)), MapProblem(chain, closures, BiasPrior(0.02, 1e-9)), 30
    )
    assert fit.bias == pytest.approx(0.02, abs=1e-9)
    assert apart(fit.poses, truth) > 0.05


@settings(max_examples=15)
@given(seeds, st.sampled_from([SURE, 3.0]))
def test_a_step_is_gauss_newtons(seed, scale):
    stream = np.random.default_rng(seed)
    truth, chain, closures = laps(stream, 0.04, 8, 0.02)
    closures = closures._replace(scale=np.full(3, scale))
    start, bias, prior = truth + stream.normal(0, 0.03, truth.shape), 0.01, BiasPrior(0.03, 0.02)
    weights = (scale / (scale + sequence_means(parts(start, bias, chain, closures)[1], closures))) ** 2
    x = unknowns(start, bias)

    def errors(x):
        return residuals(x, start[0], chain, closures, prior, weights)

    step = np.linalg.lstsq(slopes(errors, x), -errors(x), rcond=None)[0]
    fit = solve(MapFit(start, bias, np.zeros(0)), MapProblem(chain, closures, prior), 1)
    assert np.allclose(fit.weights, weights)
    assert np.allclose(wrap(unknowns(fit.poses, fit.bias) - x - step), 0, atol=1e-6)


@settings(max_examples=5)
@given(seeds)
def test_without_robust_weights_it_is_least_squares(seed):
    stream = np.random.default_rng(seed)
    _, chain, closures = laps(stream, 0.04, 8, 0.03)
    prior, start = BiasPrior(0.02, 0.02), reckoned(chain)
    fit = solve(MapFit(start, 0.0, np.zeros(0)), MapProblem(chain, closures, prior), 50)
    found = least_squares(
        residuals,
        unknowns(start, 0.0),
        args=(start[0], chain, closures, prior, np.ones(3)),
        method="lm",
        xtol=1e-12,
    )
    assert np.abs(wrap(found.x - unknowns(fit.poses, fit.bias))).max() < 1e-4
    cost = (residuals(unknowns(fit.poses, fit.bias), start[0], chain, closures, prior, np.ones(3)) ** 2).sum()
    assert cost <= 2 * found.cost * (1 + 1e-6)


def test_robust_weights_are_geman_mcclure_by_sequence():
    stream = np.random.default_rng(3)
    _, chain, closures = laps(stream, 0.04, 8, 0.02)
    # One sequence is moderately off, so that its weight, between 0 and 1, determines the optimum.
    closures = closures._replace(scale=np.full(3, 4.0), turn=closures.turn + 0.03 * (closures.sequence == 1))
    fit = solve(MapFit(reckoned(chain), 0.04, np.zeros(0)), MapProblem(chain, closures, WIDE), 500)
    assert ((fit.weights > 0.1) & (fit.weights < 0.999)).any()

    def cost(x):
        odometry, recall = parts(
            np.vstack([fit.poses[0], x[:-1].reshape(-1, 3)]), float(x[-1]), chain, closures
        )
        mean, members = sequence_means(recall, closures), np.bincount(closures.sequence)
        kernel = (members * closures.scale * mean / (closures.scale + mean)).sum()
        return (odometry**2).sum() + kernel + (x[-1] / WIDE.sd) ** 2

    x = unknowns(fit.poses, fit.bias)
    for step in 1e-3 * np.eye(len(x)):
        assert min(cost(x + step), cost(x - step)) > cost(x)


@pytest.mark.parametrize("bias", [0.0, 0.03])
def test_a_sequence_far_off_has_no_effect(bias):
    stream = np.random.default_rng(1)
    _, chain, closures = laps(stream, bias, noise=0.01)
    closures = closures._replace(scale=np.full(3, 10.0))
    right = solve(MapFit(reckoned(chain), bias, np.zeros(0)), MapProblem(chain, closures, WIDE), 50)
    false = closed([(k, k + 12) for k in range(2, 8)], np.zeros(6), np.full(6, 3), [10.0])
    both = LoopClosures(
        *(np.concatenate([a, b]) for a, b in zip(closures[:4], false[:4], strict=True)),
        CLOSURE,
        np.full(4, 10.0),
    )
    fit = solve(MapFit(reckoned(chain), bias, np.zeros(0)), MapProblem(chain, both, WIDE), 50)
    assert fit.weights[3] < 1e-4
    assert fit.weights[:3].min() > 0.5
    assert np.allclose(fit.weights[:3], right.weights, atol=0.01)
    assert apart(fit.poses, right.poses) < 5e-3
    trusting = solve(
        MapFit(reckoned(chain), bias, np.zeros(0)),
        MapProblem(chain, both._replace(scale=np.full(4, SURE)), WIDE),
        50,
    )
    assert apart(trusting.poses, right.poses) > 0.3


def robust_case(seed, cost_limit, count=8):
    """Laps with noise, a start that is off, and sequences of which the second is false."""
    stream = np.random.default_rng(seed)
    truth, chain, closures = laps(stream, 0.04, count, 0.02)
    turn = closures.turn + (closures.sequence == 1) * stream.uniform(-0.5, 0.5)
    closures = closures._replace(scale=stream.uniform(1, 20, 3), cost_limit=cost_limit, turn=turn)
    start = truth + stream.normal(0, 0.05, truth.shape)
    start[0] = truth[0]
    return start, chain, closures, BiasPrior(0.03, 0.02)


def cost_by_loops(fit, chain, closures, prior):
    odometry, recall = parts(fit.poses, fit.bias, chain, closures)
    cost = (odometry**2).sum() + ((fit.bias - prior.mean) / prior.sd) ** 2
    for sequence, scale in enumerate(closures.scale):
        each = [(recall[k] ** 2).sum() for k in np.flatnonzero(closures.sequence == sequence)]
        if np.isfinite(closures.cost_limit):
            each = [closures.cost_limit * chi2 / (closures.cost_limit + chi2) for chi2 in each]
        mean = sum(each) / max(len(each), 1)
        cost += len(each) * scale * mean / (scale + mean)
    return cost


@given(seeds, st.sampled_from([np.inf, 6.0, 0.5]))
def test_the_robust_cost_equals_explicit_loops(seed, cost_limit):
    start, chain, closures, prior = robust_case(seed, cost_limit)
    fit = MapFit(start, 0.01, np.zeros(3))
    assert robust_cost(fit, MapProblem(chain, closures, prior)) == pytest.approx(
        cost_by_loops(fit, chain, closures, prior), rel=1e-9
    )


def test_the_robust_cost_of_a_perfect_map_is_zero():
    truth, chain, closures = laps(np.random.default_rng(0), 0.03)
    assert (
        robust_cost(MapFit(truth, 0.03, np.zeros(3)), MapProblem(chain, closures, BiasPrior(0.03, 1.0)))
        < 1e-12
    )
    alone = closed([])
    assert robust_cost(
        MapFit(truth, 0.03, np.zeros(0)), MapProblem(chain, alone, BiasPrior(0.02, 0.01))
    ) == pytest.approx(1.0)


@given(seeds, st.sampled_from([np.inf, 20.0, 6.0]))
@settings(max_examples=40)
def test_every_step_lowers_the_robust_cost(seed, cost_limit):
    start, chain, closures, prior = robust_case(seed, cost_limit)
    fit = MapFit(start, 0.0, np.zeros(3))
    costs = [robust_cost(fit, MapProblem(chain, closures, prior))]
    for _ in range(25):
        fit = solve(MapFit(fit.poses, fit.bias, np.zeros(0)), MapProblem(chain, closures, prior), 1)
        costs.append(robust_cost(fit, MapProblem(chain, closures, prior)))
    assert (np.diff(costs) <= 1e-9 * np.array(costs[:-1])).all()
    assert costs[-1] < 0.5 * costs[0]


@pytest.mark.parametrize("cost_limit", [6.0, 1.0])
def test_the_solution_has_the_least_robust_cost(cost_limit):
    start, chain, closures, prior = robust_case(3, cost_limit)
    fit = solve(MapFit(start, 0.0, np.zeros(0)), MapProblem(chain, closures, prior), 500)
    assert ((fit.weights > 0.01) & (fit.weights < 0.999)).any()
    least = robust_cost(fit, MapProblem(chain, closures, prior))
    for k in range(1, len(fit.poses)):
        for step in 1e-3 * np.eye(3):
            for sign in (1, -1):
                poses = fit.poses.copy()
                poses[k] += sign * step
                assert robust_cost(fit._replace(poses=poses), MapProblem(chain, closures, prior)) > least


def test_one_false_closure_does_not_cost_its_sequence():
    truth, chain, closures = laps(np.random.default_rng(1), 0.0, noise=0.005)
    closures = closures._replace(scale=np.full(3, 4.0))
    astray = closures._replace(i=np.where(np.arange(len(closures.i)) == 5, 20, closures.i))
    strict = solve(MapFit(reckoned(chain), 0.0, np.zeros(0)), MapProblem(chain, astray, WIDE), 50)
    lenient = solve(
        MapFit(reckoned(chain), 0.0, np.zeros(0)),
        MapProblem(chain, astray._replace(cost_limit=6.0), WIDE),
        50,
    )
    sequence = closures.sequence[5]
    assert strict.weights[sequence] < 0.01
    assert lenient.weights[sequence] > 0.25
    assert apart(lenient.poses, truth) < 0.1


def test_a_coarser_tolerance_takes_fewer_steps():
    start, chain, closures, prior = robust_case(0, 6.0)
    fine = solve(MapFit(start, 0.0, np.zeros(0)), MapProblem(chain, closures, prior), 100, 1e-9)
    for tolerance in (1e-3, 1e-5):
        coarse = solve(MapFit(start, 0.0, np.zeros(0)), MapProblem(chain, closures, prior), 100, tolerance)
        assert 0 < apart(coarse.poses, fine.poses) < 100 * tolerance
    assert np.array_equal(
        solve(MapFit(start, 0.0, np.zeros(0)), MapProblem(chain, closures, prior), 1, 1e-9).poses,
        solve(MapFit(start, 0.0, np.zeros(0)), MapProblem(chain, closures, prior), 100, 1e3).poses,
    )


@given(seeds)
@settings(max_examples=20)
def test_relative_covariance_is_the_marginal_of_the_whole_information(seed):
    stream = np.random.default_rng(seed)
    truth, chain, closures = laps(stream, 0.02, 6, 0.02)
    closures = closures._replace(scale=np.array([2.0, 5.0, 20.0]))
    prior = BiasPrior(0.0, 0.05)
    fit = MapFit(truth + stream.normal(0, 0.02, truth.shape), 0.01, np.zeros(3))
    i, j = stream.choice(len(truth), 2, replace=False).tolist()
    turn = stream.uniform(-3, 3)
    mean = sequence_means(parts(fit.poses, fit.bias, chain, closures)[1], closures)
    weights = (closures.scale / (closures.scale + mean)) ** 2
    x, first = unknowns(fit.poses, fit.bias), fit.poses[0]
    jacobian = slopes(lambda x: residuals(x, first, chain, closures, prior, weights), x)

    def seen(x):
        poses = np.vstack([first, x[:-1].reshape(-1, 3)])
        # Unwrapped, so that the derivative has no jump.
        return np.append(
            between(compose(poses[i], np.array([0, 0, turn])), poses[j])[:2], poses[j, 2] - poses[i, 2]
        )

    by = slopes(seen, x)
    expected = by @ np.linalg.inv(jacobian.T @ jacobian) @ by.T
    covariance = MapCovariance(fit, MapProblem(chain, closures, prior)).relative(i, j, turn)
    assert np.allclose(covariance, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


def test_covariance_is_valid_grows_along_the_chain_and_shrinks_with_closures():
    _, chain, closures = laps(np.random.default_rng(2), 0.0)
    fit, none = MapFit(reckoned(chain), 0.0, np.zeros(0)), closed([])
    for pair in [(0, 47), (5, 30), (40, 3)]:
        prior = BiasPrior(0.0, 0.02)
        free = MapCovariance(fit, MapProblem(chain, none, prior)).relative(*pair, 0.3)
        bound = MapCovariance(fit, MapProblem(chain, closures, prior)).relative(*pair, 0.3)
        for covariance in (free, bound, free - bound):
            assert np.allclose(covariance, covariance.T, rtol=0, atol=1e-9 * np.trace(free))
            assert np.linalg.eigvalsh(covariance).min() > 0
        covariance = MapCovariance(fit, MapProblem(chain, none, BiasPrior(0.0, 0.001))).relative(*pair, 0.3)
        assert np.linalg.eigvalsh(free - covariance).max() > 0.1 * np.trace(free - covariance) > 0
    straight = chained(np.tile([0.5, 0.0, 0.0], (20, 1)))
    fit = MapFit(reckoned(straight), 0.0, np.zeros(0))
    covariance = MapCovariance(fit, MapProblem(straight, none, WIDE))
    along = np.array([np.diag(covariance.relative(0, k, 0.0)) for k in range(1, 21)])
    assert (np.diff(along, axis=0) > 0).all()


@given(seeds)
@settings(max_examples=10)
def test_the_first_frame_never_moves(seed):
    stream = np.random.default_rng(seed)
    _, chain, closures = laps(stream, 0.05, noise=0.05)
    first = stream.uniform(-3, 3, 3)
    fit = solve(MapFit(reckoned(chain, first), 0.0, np.zeros(0)), MapProblem(chain, closures, WIDE), 10)
    assert np.allclose(fit.poses[0], first, rtol=0, atol=1e-14)
    assert apart(fit.poses, reckoned(chain, first)) > 0.1


def test_a_chain_alone_is_dead_reckoning_with_the_prior_bias():
    _, chain, _ = laps(np.random.default_rng(4), 0.0)
    fit = solve(
        MapFit(reckoned(chain), 0.0, np.zeros(0)), MapProblem(chain, closed([]), BiasPrior(0.03, 0.01)), 30
    )
    expected = np.vstack([START, integrate(correct_heading_bias(chain.motion, chain.length, 0.03), START)])
    assert fit.bias == pytest.approx(0.03, abs=1e-9)
    assert apart(fit.poses, expected) < 1e-6
    assert fit.weights.shape == (0,)


def test_a_single_frame_is_a_map():
    chain = chained(np.zeros((0, 3)))
    fit = solve(
        MapFit(START[None], 0.01, np.zeros(0)), MapProblem(chain, closed([]), BiasPrior(0.03, 0.01)), 5
    )
    assert np.allclose(fit.poses, START[None], rtol=0, atol=1e-14)
    assert np.isfinite(fit.bias)


def test_an_unconnected_frame_leaves_the_map_unchanged():
    chain = chained(np.tile([0.5, 0.0, 0.1], (4, 1)))
    chain.variance[-1] = np.inf
    start = reckoned(chain) + 0.01
    fit = solve(MapFit(start, 0.01, np.zeros(0)), MapProblem(chain, closed([]), WIDE), 5)
    assert np.array_equal(fit.poses, start)
    assert fit.bias == 0.01
    assert np.isinf(MapCovariance(fit, MapProblem(chain, closed([]), WIDE)).relative(0, 4, 0.0)).all()
