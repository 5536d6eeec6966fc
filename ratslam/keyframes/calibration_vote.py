"""The vote of all closure sequences on the calibration of the odometry, before any of them is accepted.

Each sequence is true with some odds, and if it is true it favours the heading biases and turn errors with
which odometry leads to its place. A false sequence favours none that others favour as well. Nothing is
linearised."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ratslam.keyframes.optimizer import CalibrationPrior

SHRINK = 2.0
"""Standard deviations of the vote by which its mean must differ from the prior's to count."""
LEAST_TURN_ERROR = 0.002
"""Least standard deviation of the turn error, rad/rad."""


class CalibrationVote(NamedTuple):
    """Result of a vote.

    Attributes:
        belief: heading bias and turn error, shrunk towards the prior. mean: the same, not shrunk. odds: [R]
            log odds that each sequence is true, with the calibration that the prior and the others vote for.
    """

    belief: CalibrationPrior
    mean: CalibrationPrior
    odds: np.ndarray


def vote(
    grid: np.ndarray,
    prior: CalibrationPrior,
    log_ratios: np.ndarray,
    score_odds: np.ndarray,
    least_bias_sd: float,
) -> CalibrationVote:
    """The vote of R sequences on the calibrations of `grid` [G, 2], rad/m and rad/rad.

    Args:
        log_ratios: [R, G] of `OdometryScan`. score_odds: [R] log odds by their scores. least_bias_sd: least
            standard deviation of the belief in the bias, rad/m.
    """
    votes = np.logaddexp(0.0, score_odds[:, None] + log_ratios)
    total = log_prior(grid, prior) + votes.sum(axis=0)
    others = total - votes
    others = others - _log_sum(others)[:, None]
    share = np.exp(total - _log_sum(total))
    bias, bias_mean, bias_sd = _belief(share, grid[:, 0], prior.bias, least_bias_sd)
    turn, turn_mean, turn_sd = _belief(share, grid[:, 1], prior.turn_error, LEAST_TURN_ERROR)
    turn_sd = turn_sd if prior.turn_error_sd > 0 else 0.0
    return CalibrationVote(
        CalibrationPrior(bias, bias_sd, turn, turn_sd),
        CalibrationPrior(bias_mean, bias_sd, turn_mean, turn_sd),
        score_odds + _log_sum(others + log_ratios),
    )


def log_prior(grid: np.ndarray, prior: CalibrationPrior) -> np.ndarray:
    """[G] log prior density of the calibrations `grid` [G, 2], up to a constant."""
    log = -0.5 * ((grid[:, 0] - prior.bias) / prior.bias_sd) ** 2
    if prior.turn_error_sd > 0:
        log = log - 0.5 * ((grid[:, 1] - prior.turn_error) / prior.turn_error_sd) ** 2
    return log


def _log_sum(values: np.ndarray) -> np.ndarray:
    """[...] logarithm of the sum of the exponentials of finite values [..., G]; scipy's function, which also
    handles other values, needs several times as long for few of them."""
    largest = values.max(axis=-1)
    return largest + np.log(np.exp(values - largest[..., None]).sum(axis=-1))


def _belief(
    share: np.ndarray, values: np.ndarray, prior: float, least_sd: float
) -> tuple[float, float, float]:
    """Mean of values [G] with weights [G], shrunk towards the prior's; the mean itself; and the standard
    deviation about the shrunk mean."""
    mean = float(share @ values)
    sd = float(np.sqrt(share @ (values - mean) ** 2))
    off = mean - prior
    kept = prior + (off * max(0.0, 1 - (SHRINK * sd / off) ** 2) if off else 0.0)
    return kept, mean, max(float(np.hypot(sd, mean - kept)), least_sd)
