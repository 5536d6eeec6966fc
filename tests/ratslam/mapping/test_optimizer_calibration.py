"""The odometry's heading bias and turn error: what they are, how the map finds them, and how sure of them and
of the poses it is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ratslam.mapping.optimizer import CalibrationPrior, MapCovariance, MapFit, MapProblem, solve
from tactile.base.se2 import between, compose, correct_heading, integrate, wrap
from tests.ratslam.mapping.optimizer_cases import (
    BOTH_WIDE,
    START,
    WIDE,
    apart,
    chained,
    closed,
    fit_of,
    from_odometry,
    laps,
    miscalibrated,
    reckoned,
    residuals,
    robust_weights,
    slopes,
    unknowns,
)

seeds = st.integers(0, 1000)


@given(
    st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3.1, 3.1)), st.floats(0, 5), st.floats(-0.2, 0.2)
)
def test_opposite_corrections_cancel_and_zero_changes_nothing(motion, length, bias):
    motion = np.array(motion)
    assert np.allclose(correct_heading(motion, length, 0.0), motion, atol=1e-12)
    there = correct_heading(motion, length, bias)
    assert abs(wrap(there[2] - motion[2] - bias * length)) < 1e-12
    assert np.allclose(correct_heading(there, length, -bias), motion, atol=1e-12)


@given(st.floats(0.5, 4), st.floats(-0.05, 0.05))
def test_a_bias_accumulates_evenly(length, bias):
    straight = np.array([length, 0.0, 0.0])
    whole, half = (correct_heading(straight, length, bias), correct_heading(straight / 2, length / 2, bias))
    gap = between(whole, compose(half, half))
    assert abs(gap[2]) < 1e-12
    # The chord replaces the arc: an error of second order in the turn; a one-sided rule has first order.
    assert np.hypot(*gap[:2]) < length * (bias * length) ** 2 / 30 + 1e-12


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


def test_a_bias_alone_does_not_explain_a_turn_error():
    truth, chain, closures = laps(np.random.default_rng(0), 0.03, turn_error=0.2)
    fit = solve(from_odometry(chain), MapProblem(chain, closures, WIDE), 30)
    assert apart(fit.poses, truth) > 0.01
    assert fit.turn_error == 0.0


def test_a_certain_prior_holds_the_calibration():
    truth, chain, closures = laps(np.random.default_rng(0), 0.05, turn_error=0.1)
    prior = CalibrationPrior(0.02, 1e-9, -0.03, 1e-9)
    fit = solve(from_odometry(chain), MapProblem(chain, closures, prior), 30)
    assert fit.bias == pytest.approx(0.02, abs=1e-9)
    assert fit.turn_error == pytest.approx(-0.03, abs=1e-9)
    assert apart(fit.poses, truth) > 0.05


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


def test_covariance_is_valid_grows_along_the_chain_and_shrinks_with_closures():
    _, chain, closures = laps(np.random.default_rng(2), 0.0)
    fit, none = from_odometry(chain), closed([])
    for pair in [(0, 47), (5, 30), (40, 3)]:
        prior = CalibrationPrior(0.0, 0.02)
        free = MapCovariance(fit, MapProblem(chain, none, prior)).relative(*pair, 0.3)
        bound = MapCovariance(fit, MapProblem(chain, closures, prior)).relative(*pair, 0.3)
        for covariance in (free, bound, free - bound):
            assert np.allclose(covariance, covariance.T, rtol=0, atol=1e-9 * np.trace(free))
            assert np.linalg.eigvalsh(covariance).min() > 0
        sure, turning = CalibrationPrior(0.0, 0.001), CalibrationPrior(0.0, 0.02, 0.0, 0.05)
        narrow, wide = (
            MapCovariance(fit, MapProblem(chain, none, prior)).relative(*pair, 0.3)
            for prior in (sure, turning)
        )
        for less in (free - narrow, wide - free):
            assert np.linalg.eigvalsh(less).max() > 0.1 * np.trace(less) > 0
    straight = chained(np.tile([0.5, 0.0, 0.0], (20, 1)))
    fit = from_odometry(straight)
    covariance = MapCovariance(fit, MapProblem(straight, none, WIDE))
    along = np.array([np.diag(covariance.relative(0, k, 0.0)) for k in range(1, 21)])
    assert (np.diff(along, axis=0) > 0).all()


def test_a_chain_alone_is_dead_reckoning_with_the_calibration_of_the_prior():
    _, chain, _ = laps(np.random.default_rng(4), 0.0)
    prior = CalibrationPrior(0.03, 0.01, -0.05, 0.02)
    fit = solve(from_odometry(chain), MapProblem(chain, closed([]), prior), 30)
    moved = correct_heading(chain.motion, chain.length, 0.03, -0.05)
    assert fit.bias == pytest.approx(0.03, abs=1e-9)
    assert fit.turn_error == pytest.approx(-0.05, abs=1e-9)
    assert apart(fit.poses, np.vstack([START, integrate(moved, START)])) < 1e-6
    assert np.allclose(fit.corrected(chain), moved, atol=1e-9)
    assert fit.weights.shape == (0,)


def test_an_unconnected_frame_leaves_the_map_unchanged():
    chain = chained(np.tile([0.5, 0.0, 0.1], (4, 1)))
    chain.variance[-1] = np.inf
    start = reckoned(chain) + 0.01
    fit = solve(MapFit(start, 0.01, np.zeros(0)), MapProblem(chain, closed([]), WIDE), 5)
    assert np.array_equal(fit.poses, start)
    assert fit.bias == 0.01
    assert np.isinf(MapCovariance(fit, MapProblem(chain, closed([]), WIDE)).relative(0, 4, 0.0)).all()
