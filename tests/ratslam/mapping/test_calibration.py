"""The calibration and noise of odometry that a map learns, errs by as it says, and starts a session from."""

import numpy as np
import pytest
import yaml
from pydantic import ValidationError
from scipy.stats import chi2

from ratslam.mapping import odometry_calibration as calibrations
from ratslam.mapping.config import Ablation, KeyframeMapConfig
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.optimizer import CalibrationPrior, MapCovariance, MapFit, MapProblem, System, solve
from tactile.base.se2 import between, compose, wrap
from tests.ratslam.mapping import optimizer_cases as cases
from tests.ratslam.mapping.map_cases import BIAS, CELL, LAP, TRUE, add, drive, new_graph, new_map, with_log
from tests.ratslam.mapping.optimizer_cases import BOTH_WIDE, CLOSURE, WIDE, closed, from_odometry, residuals

WIDE_CELL, EIGHT, SESSIONS = 0.2, 32, 20
CONFIG = KeyframeMapConfig()


def simulated(seed):
    """Two laps of a figure of eight: true poses [N, 3], calibration [2] (rad/m, rad/rad), the problem given
    to the map, and its fit. Closures of the second lap are true; noise is as the settings of the map say."""
    stream = np.random.default_rng(seed)
    graph = new_graph(WIDE_CELL, 5, ablation=Ablation(robust=False))
    at = 2 * np.pi * np.arange(EIGHT) / EIGHT
    x, y = 8 * WIDE_CELL * np.sin(at), 6 * WIDE_CELL * np.sin(2 * at)
    ahead = np.arctan2(12 * np.cos(2 * at), 8 * np.cos(at))
    spread = [CONFIG.closure_sd * WIDE_CELL] * 2 + [CONFIG.closure_heading]
    first = np.stack([x, y, ahead], axis=1)
    truth = np.concatenate([first, compose(first, spread * stream.normal(0, 1, first.shape))])
    motion = np.concatenate([np.zeros((1, 3)), between(truth[:-1], truth[1:])])
    length = np.hypot(motion[:, 0], motion[:, 1])
    for row, travelled in zip(motion, length, strict=True):
        add(graph, row, truth[0], travelled)
    noise = np.sqrt(graph.variances()) * stream.normal(0, 1, motion.shape)
    calibration = stream.normal(0, 1, 2) * [graph.prior.bias_sd, graph.prior.turn_error_sd]
    graph.motion.rows[1:] = cases.miscalibrated(motion + noise, length, *calibration)[1:]
    log = ClosureLog()
    for k in range(0, EIGHT, 2):
        log.judge(log.add(Candidate(EIGHT + k, k, 0, 1.0, 5.0), k % 8 > 0), Verdict.ACCEPTED)
    graph.dead_reckon()
    problem = with_log(graph, log, graph.cut).problem()
    return truth, calibration, problem, solve(graph.fit(), problem, 50, 1e-7)


def whitened(fit, problem):
    """Errors of a problem without robust weights at a fit, and their derivatives by finite differences."""
    chain, closures, prior, _ = problem
    rest, x = (fit, chain, closures, prior, np.ones(len(closures.scale))), cases.unknowns(fit, prior)
    return residuals(x, *rest), cases.slopes(lambda x: residuals(x, *rest), x)


def assert_as_large(errors, covariances):
    """Errors squared are as large as said: their mean over all sessions is where 95 % of the means are."""
    pairs = zip(errors, covariances, strict=True)
    low, high = chi2.ppf([0.025, 0.975], len(errors[0]) * SESSIONS) / SESSIONS
    assert low < np.mean([error @ np.linalg.solve(covariance, error) for error, covariance in pairs]) < high


def test_the_calibration_and_the_poses_err_as_much_as_the_covariance_of_the_map_says():
    sessions, errors, covariances = [simulated(seed) for seed in range(SESSIONS)], [], []
    for _, calibration, problem, fit in sessions:
        jacobian = whitened(fit, problem)[1]
        covariances.append(np.linalg.inv(jacobian.T @ jacobian)[-2:, -2:])
        errors.append(np.array([fit.bias, fit.turn_error]) - calibration)
        deviation = MapCovariance(fit, problem).calibration_sd()
        assert deviation == pytest.approx(np.sqrt(np.diag(covariances[-1])), rel=1e-4)
    assert_as_large(errors, covariances)
    for keyframe in (EIGHT // 2, 2 * EIGHT - 1):
        errors, covariances = [], []
        for truth, _, problem, fit in sessions:
            error = between(fit.poses[0], fit.poses[keyframe]) - between(truth[0], truth[keyframe])
            errors.append(np.array([*error[:2], wrap(error[2])]))
            covariances.append(MapCovariance(fit, problem).relative(0, keyframe, 0.0))
        assert_as_large(errors, covariances)


def started(path, write):
    """The settings of a session that starts from the calibration that is written."""
    write(path)
    return KeyframeMapConfig.model_validate(yaml.safe_load(path.read_text())["keyframes"])


def test_what_is_written_is_what_the_next_session_starts_from(tmp_path):
    known, noise = CalibrationPrior(0.0123, 0.004, -0.05, 0.006), calibrations.HeadingNoise(np.log(1.7), 0.2)
    path = tmp_path / "calibration.yaml"
    config = started(path, lambda path: calibrations.write_calibration(path, known, noise))
    assert calibrations.starting_calibration(config, CELL) == pytest.approx(known)
    assert calibrations.HeadingNoise.of_start(config).factor == pytest.approx(noise.factor)
    straight = config.model_copy(update={"turn_error_sd": 0.0})  # turns without systematic error
    assert calibrations.starting_calibration(straight, CELL)[2:] == (0.0, 0.0)
    expected = CalibrationPrior(0.0, CONFIG.bias_sd / CELL, 0.0, CONFIG.turn_error_sd)
    assert calibrations.starting_calibration(CONFIG, CELL) == expected
    assert calibrations.HeadingNoise.of_start(CONFIG) == calibrations.HeadingNoise()


@pytest.mark.parametrize("wrong", [{"turn_error": -1.0}, {"heading_bias_sd": 0.0}, {"heading_noise": 0.0}])
def test_impossible_calibrations_are_refused(wrong):
    with pytest.raises(ValidationError):
        KeyframeMapConfig.model_validate({"calibration": wrong})


def test_a_finished_map_writes_the_bias_that_closures_show_and_the_next_session_begins_with_it(tmp_path):
    """Without closures its path is that of corrected odometry, from the first step on."""
    files = drive(new_map(), TRUE).files()
    start = started(tmp_path / "calibration.yaml", files["calibration.yaml"]).calibration
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


def problem_of(stream, factor, prior=FIXED):
    """Two laps whose turns have a variance that is `factor` times the chain's, and their fit."""
    _, chain, closures = cases.laps(stream)
    sd = np.sqrt(chain.variance) * [1, 1, np.sqrt(factor)]
    chain = chain._replace(motion=chain.motion + sd * stream.normal(0, 1, chain.motion.shape))
    moved = closures._replace(turn=closures.turn + np.sqrt(CLOSURE[2]) * stream.normal(0, 1, len(closures.i)))
    problem = MapProblem(chain, moved, prior)
    return solve(from_odometry(chain), problem, 60, 1e-9), problem


def learned(fit, problem):
    """The noise after as many maps as it takes to come to rest."""
    noise, variance = calibrations.HeadingNoise(), problem.chain.variance
    for _ in range(12):
        chain = problem.chain._replace(variance=variance * [1.0, 1.0, noise.factor])
        problem = problem._replace(chain=chain)
        fit = solve(fit, problem, 60, 1e-9)
        noise = calibrations.learn_heading_noise(noise, calibrations.HeadingNoise(), fit, problem)
    return noise


@pytest.mark.parametrize("prior", [WIDE, BOTH_WIDE])
def test_the_evidence_is_that_of_the_dense_equations(prior):
    fit, problem = problem_of(np.random.default_rng(3), 1.0, prior)
    error, jacobian = whitened(fit, problem)
    information = np.linalg.slogdet(jacobian.T @ jacobian)[1]
    expected = -0.5 * (error @ error + information + np.log(problem.chain.variance).sum())
    assert System(problem).log_evidence(fit) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("factor", [1.0, 9.0])
def test_the_noise_that_was_there_is_found(factor):
    """Within the 99 % band of its mean over sessions, drawn towards 1 by the prior."""
    found = [learned(*problem_of(np.random.default_rng(seed), factor)) for seed in range(12)]
    logs, sds = np.array([(one.log_factor, one.sd) for one in found]).T
    drawn = np.log(factor) * np.mean(1 - sds**2 / calibrations.SPREAD**2)
    assert abs(logs.mean() - drawn) < 2.6 * np.sqrt((sds**2).mean() / len(sds)) + 0.05
    assert (sds < 0.8 * calibrations.SPREAD).all()


def test_it_stays_near_the_noise_it_starts_from_without_closures_at_it_and_without_a_solution_as_it_was():
    """Accepted closures are those that agree with odometry."""
    fit, problem = problem_of(np.random.default_rng(0), 1e-3)
    for start in (calibrations.HeadingNoise(), calibrations.HeadingNoise(1.0)):
        noise = start
        for _ in range(4):
            noise = calibrations.learn_heading_noise(noise, start, fit, problem)
        assert noise.log_factor == pytest.approx(start.log_factor + np.log(calibrations.LEAST_FACTOR))
    fit, problem = problem_of(np.random.default_rng(0), 100.0)
    alone, start = problem._replace(closures=closed([])), calibrations.HeadingNoise()
    noise = calibrations.learn_heading_noise(start, start, from_odometry(problem.chain), alone)
    assert noise.log_factor == pytest.approx(0.0, abs=1e-6)
    assert noise.sd == pytest.approx(calibrations.SPREAD, rel=1e-6)
    noise = calibrations.learn_heading_noise(start, start, fit, problem)
    assert noise.log_factor == pytest.approx(calibrations.LARGEST_STEP)
    loose = problem.chain._replace(variance=np.full_like(problem.chain.variance, np.inf))
    noise = calibrations.HeadingNoise(0.3, 0.2)
    nowhere = MapFit(np.zeros((len(problem.chain.length) + 1, 3)), 0.0, np.zeros(0))
    assert calibrations.learn_heading_noise(noise, start, nowhere, problem._replace(chain=loose)) == noise
