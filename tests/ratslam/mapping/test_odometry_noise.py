"""The heading noise learned from closures: its evidence, and whether it finds the noise that was there."""

from __future__ import annotations

import numpy as np
import pytest

from ratslam.mapping.odometry_calibration import (
    LARGEST_STEP,
    LEAST_FACTOR,
    SPREAD,
    HeadingNoise,
    learn_heading_noise,
)
from ratslam.mapping.optimizer import CalibrationPrior, MapFit, MapProblem, System, solve
from tests.ratslam.mapping.optimizer_cases import (
    BOTH_WIDE,
    CLOSURE,
    WIDE,
    closed,
    from_odometry,
    laps,
    residuals,
    slopes,
    unknowns,
)

SURE = CalibrationPrior(0.0, 1e-6)


def problem_of(stream, factor, prior=SURE, count=24):
    """Two laps whose turns have a variance that is `factor` times the chain's."""
    _, chain, closures = laps(stream, count=count)
    sd = np.sqrt(chain.variance) * [1, 1, np.sqrt(factor)]
    chain = chain._replace(motion=chain.motion + sd * stream.normal(0, 1, chain.motion.shape))
    moved = closures._replace(turn=closures.turn + np.sqrt(CLOSURE[2]) * stream.normal(0, 1, len(closures.i)))
    problem = MapProblem(chain, moved, prior)
    return problem, solve(from_odometry(chain), problem, 60, 1e-9)


def learned(problem, fit, most=12):
    """The noise after as many maps as it takes to come to rest."""
    noise = HeadingNoise()
    for _ in range(most):
        factors = np.array([1.0, 1.0, noise.factor])
        chain = problem.chain._replace(variance=problem.chain.variance * factors)
        present = problem._replace(chain=chain)
        fit = solve(fit, present, 60, 1e-9)
        noise = learn_heading_noise(noise, HeadingNoise(), fit, present)
    return noise


@pytest.mark.parametrize("prior", [WIDE, BOTH_WIDE])
def test_the_evidence_is_that_of_the_dense_equations(prior):
    problem, fit = problem_of(np.random.default_rng(3), 1.0, prior)
    weights = np.ones(len(problem.closures.scale))
    x = unknowns(fit, prior)

    def whitened(x):
        return residuals(x, fit, problem.chain, problem.closures, prior, weights)

    jacobian, error = slopes(whitened, x), whitened(x)
    information = np.linalg.slogdet(jacobian.T @ jacobian)[1]
    expected = -0.5 * (error @ error + information + np.log(problem.chain.variance).sum())
    assert System(problem).log_evidence(fit) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("factor", [1.0, 4.0, 9.0])
def test_the_noise_that_was_there_is_found(factor):
    """Within the 99 % band of its mean over sessions, drawn towards 1 by the prior."""
    found = [learned(*problem_of(np.random.default_rng(seed), factor)) for seed in range(12)]
    logs, sds = np.array([(one.log_factor, one.sd) for one in found]).T
    drawn = np.log(factor) * np.mean(1 - sds**2 / SPREAD**2)
    assert abs(logs.mean() - drawn) < 2.6 * np.sqrt((sds**2).mean() / len(sds)) + 0.05
    assert (sds < 0.8 * SPREAD).all()


def test_it_moves_by_at_most_one_step():
    problem, fit = problem_of(np.random.default_rng(0), 100.0)
    noise = learn_heading_noise(HeadingNoise(), HeadingNoise(), fit, problem)
    assert noise.log_factor == pytest.approx(LARGEST_STEP)


def test_it_does_not_fall_far_below_the_noise_it_starts_from():
    """Accepted closures are those that agree with odometry."""
    for start in (HeadingNoise(), HeadingNoise(1.0)):
        problem, fit = problem_of(np.random.default_rng(0), 1e-3)
        noise = start
        for _ in range(4):
            noise = learn_heading_noise(noise, start, fit, problem)
        assert noise.log_factor == pytest.approx(start.log_factor + np.log(LEAST_FACTOR))


def test_without_closures_it_stays_as_it_is_expected_to_be():
    problem, _ = problem_of(np.random.default_rng(0), 4.0)
    alone = problem._replace(closures=closed([]))
    noise = learn_heading_noise(HeadingNoise(), HeadingNoise(), from_odometry(problem.chain), alone)
    assert noise.log_factor == pytest.approx(0.0, abs=1e-6)
    assert noise.sd == pytest.approx(SPREAD, rel=1e-6)


def test_singular_equations_change_nothing():
    problem, _ = problem_of(np.random.default_rng(0), 1.0)
    loose = problem.chain._replace(variance=np.full_like(problem.chain.variance, np.inf))
    noise = HeadingNoise(0.3, 0.2)
    nowhere = MapFit(np.zeros((len(problem.chain.length) + 1, 3)), 0.0, np.zeros(0))
    assert learn_heading_noise(noise, HeadingNoise(), nowhere, problem._replace(chain=loose)) == noise
