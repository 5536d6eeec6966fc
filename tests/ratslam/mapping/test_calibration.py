"""The calibration and noise of odometry that a map learns: it errs as much as it says, and the next session
starts from it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import yaml
from pydantic import ValidationError
from scipy.stats import chi2

from ratslam.mapping.config import Ablation, KeyframeMapConfig
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.odometry_calibration import (
    LARGEST_STEP,
    LEAST_FACTOR,
    SPREAD,
    HeadingNoise,
    learn_heading_noise,
    starting_calibration,
    write_calibration,
)
from ratslam.mapping.optimizer import CalibrationPrior, MapCovariance, MapFit, MapProblem, System, solve
from tactile.base.se2 import between, compose, wrap
from tests.ratslam.mapping.map_cases import BIAS, CELL, LAP, TRUE, add, drive, new_graph, new_map, with_log
from tests.ratslam.mapping.optimizer_cases import (
    BOTH_WIDE,
    CLOSURE,
    WIDE,
    closed,
    from_odometry,
    laps,
    miscalibrated,
    residuals,
    slopes,
    unknowns,
)

WIDE_CELL, EIGHT, SESSIONS = 0.2, 32, 20
CONFIG = KeyframeMapConfig()


class Session(NamedTuple):
    """True poses [N, 3] and calibration [2] (rad/m, rad/rad), the problem given to the map, and its fit."""

    truth: np.ndarray
    calibration: np.ndarray
    problem: MapProblem
    fit: MapFit


def simulated(seed):
    """Two laps of a figure of eight, with turns to both sides. Closures of the second lap are true but for
    their noise; calibration, odometry and closures are drawn as the settings of the map say."""
    stream = np.random.default_rng(seed)
    graph = new_graph(WIDE_CELL, 5, ablation=Ablation(robust=False))
    at = 2 * np.pi * np.arange(EIGHT) / EIGHT
    x, y = 8 * WIDE_CELL * np.sin(at), 6 * WIDE_CELL * np.sin(2 * at)
    ahead = np.arctan2(12 * np.cos(2 * at), 8 * np.cos(at))
    spread = np.array([CONFIG.closure_sd * WIDE_CELL, CONFIG.closure_sd * WIDE_CELL, CONFIG.closure_heading])
    first = np.stack([x, y, ahead], axis=1)
    truth = np.concatenate([first, compose(first, spread * stream.normal(0, 1, first.shape))])
    motion = np.concatenate([np.zeros((1, 3)), between(truth[:-1], truth[1:])])
    length = np.hypot(motion[:, 0], motion[:, 1])
    for row, travelled in zip(motion, length, strict=True):
        add(graph, row, truth[0], travelled)
    noise = np.sqrt(graph.variances()) * stream.normal(0, 1, motion.shape)
    calibration = stream.normal(0, 1, 2) * [graph.prior.bias_sd, graph.prior.turn_error_sd]
    graph.motion.rows[1:] = miscalibrated(motion + noise, length, *calibration)[1:]
    log = ClosureLog()
    for k in range(0, EIGHT, 2):
        log.judge(log.add(Candidate(EIGHT + k, k, 0, 1.0, 5.0), k % 8 > 0), Verdict.ACCEPTED)
    graph.dead_reckon()
    problem = with_log(graph, log, graph.cut).problem()
    return Session(truth, calibration, problem, solve(graph.fit(), problem, 50, 1e-7))


def calibration_covariance(session):
    """[2, 2] of bias and turn error, by dense inversion of the whole information."""
    chain, closures, prior, _ = session.problem
    weights = np.ones(len(closures.scale))
    x = unknowns(session.fit, prior)
    jacobian = slopes(lambda x: residuals(x, session.fit, chain, closures, prior, weights), x)
    return np.linalg.inv(jacobian.T @ jacobian)[-2:, -2:]


def nees(error, covariance):
    return float(error @ np.linalg.solve(covariance, error))


def band(freedom):
    """95 % of mean errors squared over all sessions lie between these."""
    return chi2.ppf([0.025, 0.975], freedom * SESSIONS) / SESSIONS


@pytest.fixture(scope="module")
def sessions():
    return [simulated(seed) for seed in range(SESSIONS)]


def test_the_calibration_errs_as_much_as_its_covariance_says(sessions):
    errors = []
    for session in sessions:
        covariance = calibration_covariance(session)
        found = np.array([session.fit.bias, session.fit.turn_error])
        errors.append(nees(found - session.calibration, covariance))
        deviation = MapCovariance(session.fit, session.problem).calibration_sd()
        assert deviation == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-4)
    low, high = band(2)
    assert low < np.mean(errors) < high


@pytest.mark.parametrize("keyframe", [EIGHT // 2, 2 * EIGHT - 1])
def test_the_poses_err_as_much_as_the_maps_covariance_says(sessions, keyframe):
    errors = []
    for truth, _, problem, fit in sessions:
        error = between(fit.poses[0], fit.poses[keyframe]) - between(truth[0], truth[keyframe])
        error[2] = wrap(error[2])
        errors.append(nees(error, MapCovariance(fit, problem).relative(0, keyframe, 0.0)))
    low, high = band(3)
    assert low < np.mean(errors) < high


def written(path, map):
    map.files()["calibration.yaml"](path)
    return KeyframeMapConfig.model_validate(yaml.safe_load(path.read_text())["keyframes"])


def test_what_is_written_is_what_the_next_session_starts_from(tmp_path):
    known, noise = CalibrationPrior(0.0123, 0.004, -0.05, 0.006), HeadingNoise(np.log(1.7), 0.2)
    write_calibration(tmp_path / "calibration.yaml", known, noise)
    text = (tmp_path / "calibration.yaml").read_text()
    config = KeyframeMapConfig.model_validate(yaml.safe_load(text)["keyframes"])
    assert starting_calibration(config, CELL) == pytest.approx(known)
    assert HeadingNoise.of_start(config).factor == pytest.approx(noise.factor)
    straight = config.model_copy(update={"turn_error_sd": 0.0})  # turns without systematic error
    assert starting_calibration(straight, CELL)[2:] == (0.0, 0.0)
    expected = CalibrationPrior(0.0, CONFIG.bias_sd / CELL, 0.0, CONFIG.turn_error_sd)
    assert starting_calibration(CONFIG, CELL) == expected
    assert HeadingNoise.of_start(CONFIG) == HeadingNoise()


def test_impossible_calibrations_are_refused():
    for wrong in ({"turn_error": -1.0}, {"heading_bias_sd": 0.0}, {"heading_noise": 0.0}):
        with pytest.raises(ValidationError):
            KeyframeMapConfig.model_validate({"calibration": wrong})


def test_a_finished_map_writes_the_bias_that_closures_show_and_the_next_session_begins_with_it(tmp_path):
    """Without closures its path is that of corrected odometry, from the first step on."""
    start = written(tmp_path / "calibration.yaml", drive(new_map(), TRUE)).calibration
    assert start.heading_bias == pytest.approx(BIAS, abs=3 * start.heading_bias_sd)
    assert start.heading_bias_sd < new_map().config.bias_sd / CELL
    warm, cold = drive(new_map(calibration=start.model_dump()), {}), drive(new_map(), {})
    assert warm.state.unmerged.bias == start.heading_bias
    turned = 2 * np.pi / LAP * (LAP + 59)
    off = [abs(wrap(one.trajectory()[-1, 2] - one.trajectory()[0, 2] - turned)) for one in (warm, cold)]
    assert off[0] < 0.2 * off[1]


def test_the_live_pose_is_odometry_until_a_closure_is_accepted():
    """Before that, a heading bias is no more than a belief, and it may be wrong."""
    map = drive(new_map(), {}, last=60)
    graph = map.state.unmerged
    expected = graph.dead_reckoned()[-1]
    graph.bias = 0.05
    graph.dead_reckon()
    assert graph.pose.rows[-1] != pytest.approx(expected)
    assert map.pose(None) == pytest.approx(expected)
    closed = drive(new_map(), TRUE)
    assert len(closed.closures())
    assert closed.pose(None) == pytest.approx(closed.state.unmerged.pose.rows[-1])


FIXED = CalibrationPrior(0.0, 1e-6)


def problem_of(stream, factor, prior=FIXED, count=24):
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


@pytest.mark.parametrize("factor", [1.0, 9.0])
def test_the_noise_that_was_there_is_found(factor):
    """Within the 99 % band of its mean over sessions, drawn towards 1 by the prior."""
    found = [learned(*problem_of(np.random.default_rng(seed), factor)) for seed in range(12)]
    logs, sds = np.array([(one.log_factor, one.sd) for one in found]).T
    drawn = np.log(factor) * np.mean(1 - sds**2 / SPREAD**2)
    assert abs(logs.mean() - drawn) < 2.6 * np.sqrt((sds**2).mean() / len(sds)) + 0.05
    assert (sds < 0.8 * SPREAD).all()


def test_it_does_not_fall_far_below_the_noise_it_starts_from():
    """Accepted closures are those that agree with odometry."""
    problem, fit = problem_of(np.random.default_rng(0), 1e-3)
    for start in (HeadingNoise(), HeadingNoise(1.0)):
        noise = start
        for _ in range(4):
            noise = learn_heading_noise(noise, start, fit, problem)
        assert noise.log_factor == pytest.approx(start.log_factor + np.log(LEAST_FACTOR))


def test_without_closures_it_stays_as_it_is_expected_to_be_and_without_a_solution_as_it_was():
    problem, fit = problem_of(np.random.default_rng(0), 100.0)
    alone, start = problem._replace(closures=closed([])), HeadingNoise()
    noise = learn_heading_noise(start, start, from_odometry(problem.chain), alone)
    assert noise.log_factor == pytest.approx(0.0, abs=1e-6)
    assert noise.sd == pytest.approx(SPREAD, rel=1e-6)
    assert learn_heading_noise(start, start, fit, problem).log_factor == pytest.approx(LARGEST_STEP)
    loose = problem.chain._replace(variance=np.full_like(problem.chain.variance, np.inf))
    noise = HeadingNoise(0.3, 0.2)
    nowhere = MapFit(np.zeros((len(problem.chain.length) + 1, 3)), 0.0, np.zeros(0))
    assert learn_heading_noise(noise, start, nowhere, problem._replace(chain=loose)) == noise
