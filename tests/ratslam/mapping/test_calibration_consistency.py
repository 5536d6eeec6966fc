"""Whether the map errs as much as it says: normalised estimation errors squared (NEES) of simulated sessions
whose noise is that of the model."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy.stats import chi2

from ratslam.mapping.appearance import LabelAppearance
from ratslam.mapping.config import Ablation, KeyframeMapConfig
from ratslam.mapping.keyframe_graph import KeyframeGraph
from ratslam.mapping.loop_closures import Candidate, ClosureLog, Verdict
from ratslam.mapping.optimizer import MapCovariance, MapFit, MapProblem, solve
from tactile.base.se2 import between, compose, wrap
from tests.ratslam.mapping.optimizer_cases import miscalibrated, residuals, slopes, unknowns

CELL, LAP, SESSIONS = 0.2, 32, 30
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
    graph = KeyframeGraph(CONFIG, CELL, LabelAppearance(), 5, Ablation(robust=False))
    at = 2 * np.pi * np.arange(LAP) / LAP
    x, y = 8 * CELL * np.sin(at), 6 * CELL * np.sin(2 * at)
    ahead = np.arctan2(12 * np.cos(2 * at), 8 * np.cos(at))
    spread = np.array([CONFIG.closure_sd * CELL, CONFIG.closure_sd * CELL, CONFIG.closure_heading])
    first = np.stack([x, y, ahead], axis=1)
    truth = np.concatenate([first, compose(first, spread * stream.normal(0, 1, first.shape))])
    motion = np.concatenate([np.zeros((1, 3)), between(truth[:-1], truth[1:])])
    length = np.hypot(motion[:, 0], motion[:, 1])
    for row, travelled in zip(motion, length, strict=True):
        graph.append(truth[0], row, travelled, abs(row[2]))
    noise = np.sqrt(graph.variances(graph.cut)) * stream.normal(0, 1, motion.shape)
    calibration = stream.normal(0, 1, 2) * [graph.prior.bias_sd, graph.prior.turn_error_sd]
    graph.motion.rows[1:] = miscalibrated(motion + noise, length, *calibration)[1:]
    log = ClosureLog()
    for k in range(0, LAP, 2):
        log.judge(log.add(Candidate(LAP + k, k, 0, 1.0, 5.0), k % 8 > 0), Verdict.ACCEPTED)
    graph.dead_reckon()
    problem = graph.problem(log, graph.cut)
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
        found = np.array([session.fit.bias, session.fit.turn_error])
        errors.append(nees(found - session.calibration, calibration_covariance(session)))
    low, high = band(2)
    assert low < np.mean(errors) < high


@pytest.mark.parametrize("keyframe", [LAP // 2, LAP - 1, 2 * LAP - 1])
def test_the_poses_err_as_much_as_the_maps_covariance_says(sessions, keyframe):
    errors = []
    for truth, _, problem, fit in sessions:
        error = between(fit.poses[0], fit.poses[keyframe]) - between(truth[0], truth[keyframe])
        error[2] = wrap(error[2])
        errors.append(nees(error, MapCovariance(fit, problem).relative(0, keyframe, 0.0)))
    low, high = band(3)
    assert low < np.mean(errors) < high


def test_closures_tell_bias_and_turn_error_apart(sessions):
    """The sessions are a test of what is found, not of the prior alone."""
    prior = sessions[0].problem.prior
    found = np.mean([np.sqrt(np.diag(calibration_covariance(each))) for each in sessions[:5]], axis=0)
    assert (found < 0.4 * np.array([prior.bias_sd, prior.turn_error_sd])).all()
