"""Laps with closures for the optimiser, and its residuals by finite differences."""

import numpy as np

from ratslam.mapping.optimizer import CalibrationPrior, LoopClosures, MapFit, OdometryChain
from tactile.base.se2 import between, compose, correct_heading, integrate, wrap

WIDE = CalibrationPrior(0.0, 10.0)
BOTH_WIDE = CalibrationPrior(0.0, 10.0, 0.0, 10.0)
SURE = 1e12  # robust scale at which no sequence loses weight
CLOSURE = np.array([0.02, 0.02, 0.01]) ** 2
START = np.array([2.0, -1.0, 3.0])  # not the origin, and near the wrap of angles


def chained(motion, sd=(0.02, 0.02, 0.01)):
    variance = np.tile(np.square(sd), (len(motion), 1))
    return OdometryChain(motion, np.hypot(motion[:, 0], motion[:, 1]), variance)


def closed(pairs, turn=(), sequence=(), scale=()):
    i, j = np.array(pairs, int).reshape(-1, 2).T
    return LoopClosures(i, j, np.array(turn, float), np.array(sequence, int), CLOSURE, np.array(scale, float))


def miscalibrated(motion, length, bias, turn_error):
    """The motions [N, 3] that the corrections turn into these."""
    turn = (motion[:, 2] - bias * length) / (1 + turn_error)
    missing = np.exp(0.5j * (turn - motion[:, 2])) * (motion[:, 0] + 1j * motion[:, 1])
    return np.stack([missing.real, missing.imag, turn], axis=1)


def laps(stream, bias=0.0, count=24, noise=0.0, turn_error=0.0):
    """Two laps of an ellipse, the second seen turned: truth, odometry, true closures in 3 sequences."""
    at = 2 * np.pi * np.arange(2 * count) / count
    truth = np.stack([3 * np.cos(at), 2 * np.sin(at), wrap(at + np.pi / 2)], axis=1)
    turn = np.where(np.arange(2 * count) < count, 0.0, stream.uniform(-0.6, 0.6, 2 * count))
    truth = compose(truth, np.outer(turn, [0, 0, 1]))
    truth = compose(compose(START, between(truth[0], np.zeros(3))), truth)
    motion = between(truth[:-1], truth[1:])
    chain = chained(miscalibrated(motion, np.hypot(motion[:, 0], motion[:, 1]), bias, turn_error))
    chain = chain._replace(motion=chain.motion + noise * stream.normal(0, 1, motion.shape) * [1, 1, 0.5])
    i = np.arange(1, count, 2)
    sequence = np.arange(len(i)) * 3 // len(i)
    return truth, chain, closed(np.stack([i, i + count], 1), turn[i + count], sequence, [SURE] * 3)


def reckoned(chain, start=START):
    return np.vstack([start, integrate(chain.motion, start)])


def from_odometry(chain, bias=0.0, turn_error=0.0):
    """The fit of raw odometry, with a calibration to begin from."""
    return MapFit(reckoned(chain), bias, np.zeros(0), turn_error)


def parts(fit, chain, closures):
    """Whitened residuals of the chain and of the closures, from the keyframes alone."""
    poses = fit.poses
    measured = correct_heading(chain.motion, chain.length, fit.bias, fit.turn_error)
    odometry = between(poses[:-1], poses[1:]) - measured
    recall = between(poses[closures.i], poses[closures.j])
    recall[:, 2] -= closures.turn
    for error in (odometry, recall):
        error[:, 2] = wrap(error[:, 2])
    return odometry / np.sqrt(chain.variance), recall / np.sqrt(closures.variance)


def robust_weights(fit, chain, closures):
    recall = (parts(fit, chain, closures)[1] ** 2).sum(axis=1)
    means = np.array([recall[closures.sequence == k].mean() for k in range(len(closures.scale))])
    return (closures.scale / (closures.scale + means)) ** 2


def unknowns(fit, prior):
    """All free poses, the bias, and the turn error if the prior leaves it free."""
    calibration = [fit.bias, fit.turn_error][: 1 + (prior.turn_error_sd > 0)]
    return np.concatenate([fit.poses[1:].ravel(), calibration])


def fit_of(x, start, prior):
    """The fit with these unknowns; what is fixed is that of `start`."""
    free = 1 + (prior.turn_error_sd > 0)
    calibration = [*x[-free:], start.turn_error][:2]
    poses = np.vstack([start.poses[0], x[:-free].reshape(-1, 3)])
    return MapFit(poses, calibration[0], np.zeros(0), calibration[1])


def residuals(x, start, chain, closures, prior, weights):
    fit = fit_of(x, start, prior)
    odometry, recall = parts(fit, chain, closures)
    recall = recall * np.sqrt(weights)[closures.sequence][:, None]
    off = [(fit.bias - prior.bias) / prior.bias_sd]
    if prior.turn_error_sd > 0:
        off.append((fit.turn_error - prior.turn_error) / prior.turn_error_sd)
    return np.concatenate([odometry.ravel(), recall.ravel(), off])


def slopes(function, x, h=1e-6):
    return np.stack([(function(x + e) - function(x - e)) / (2 * h) for e in h * np.eye(len(x))], axis=1)


def apart(a, b):
    gap = a - b
    gap[:, 2] = wrap(gap[:, 2])
    return np.abs(gap).max(initial=0.0)
