"""The calibration of the odometry: what a map starts from, and what a finished one knows.

The heading noise of the odometry, learned from the loop closures of the map.

The noise is a factor on the variance of every turn. Its evidence is the probability of odometry and closures
with the poses integrated out, to second order around the map (Laplace; MacKay 1992). A factor too small
makes the closures costly, one too large wastes the odometry. The factor has a log-normal prior, and moves by
at most `LARGEST_STEP` at a time, because the map changes with it. It does not fall below `LEAST_FACTOR`:
closures are accepted for agreeing with odometry, so odometry that is believed too much refuses true ones and
looks good.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ratslam.mapping.config import KeyframeMapConfig
from ratslam.mapping.optimizer import CalibrationPrior, MapFit, MapProblem, System
from ratslam.mapping.view_sectors import BiasEstimate

TEXT = """\
# Calibration of the odometry after this session. The next session of the same robot starts from it if its
# configuration holds these settings.
keyframes:
  calibration:
    heading_bias: {prior.bias:.6g}        # rad/m
    heading_bias_sd: {prior.bias_sd:.3g}
"""
TURNS = """\
    turn_error: {prior.turn_error:.6g}        # rad/rad
    turn_error_sd: {prior.turn_error_sd:.3g}
"""
NOISE = """\
    # factor on the variances of heading; its log is {noise.log_factor:.2f} +- {noise.sd:.2f}
    heading_noise: {noise.factor:.4g}
"""


def starting_calibration(config: KeyframeMapConfig, cell: float) -> CalibrationPrior:
    """The prior before any view and closure, for pose cells of `cell` m."""
    start, turn_sd = config.calibration, config.turn_error_sd
    if start.turn_error_sd is not None and turn_sd > 0:
        turn_sd = start.turn_error_sd
    turn = start.turn_error if turn_sd > 0 else 0.0
    return CalibrationPrior(start.heading_bias, start.heading_bias_sd or config.bias_sd / cell, turn, turn_sd)


def calibration_from_views(
    config: KeyframeMapConfig, cell: float, start: CalibrationPrior, shown: BiasEstimate
) -> CalibrationPrior:
    """The prior with the heading bias that the views show, shrunk towards that of the start where the views
    are not certain of it."""
    off, error = shown.value - start.bias, shown.error
    shrunk = start.bias + (off * max(0.0, 1 - (config.shrink * error / off) ** 2) if off else 0.0)
    sd = min(np.hypot(error, shown.value - shrunk), 2 * start.bias_sd)
    sd = max(sd, min(config.bias_least / cell, start.bias_sd))
    return start._replace(bias=shrunk, bias_sd=float(sd))


def starting_noise(config: KeyframeMapConfig) -> HeadingNoise:
    """The noise of heading before any closure."""
    return HeadingNoise(float(np.log(config.calibration.heading_noise)))


def write_calibration(path: Path, calibration: CalibrationPrior, noise: HeadingNoise | None) -> None:
    """Writes means and standard deviations as settings of a configuration.

    Args:
        noise: None where it is not learned.
    """
    text = TEXT + TURNS * (calibration.turn_error_sd > 0) + NOISE * (noise is not None)
    path.write_text(text.format(prior=calibration, noise=noise), encoding="utf-8")


SPREAD = 1.0
"""Standard deviation of the log of the factor before any closure."""
LARGEST_STEP = float(np.log(2.0))
"""Largest change of the log of the factor; also the distance between the factors compared."""
LEAST_FACTOR = 0.5
"""Least factor, of the noise that the map starts from."""
STEPS = 2
"""Solver iterations at each factor compared."""


class HeadingNoise(NamedTuple):
    """Log of the factor on the variance of the odometry's turns, and its standard deviation."""

    log_factor: float = 0.0
    sd: float = SPREAD

    @property
    def factor(self) -> float:
        """On the variance."""
        return float(np.exp(self.log_factor))

    @property
    def further_factor(self) -> float:
        """On the variance of a further session or piece, beside `factor`. A map learns the noise of its own
        session, and little of it from few loop closures: that of others is not taken to be less than the
        settings say."""
        return 1 / min(self.factor, 1.0)


def learn_heading_noise(
    noise: HeadingNoise, start: HeadingNoise, fit: MapFit, problem: MapProblem
) -> HeadingNoise:
    """The noise after one more map.

    Args:
        noise: with which `problem` was made. start: that of the first map. fit: that solves the problem.
    """
    least = start.log_factor + float(np.log(LEAST_FACTOR))
    steps = np.array([-LARGEST_STEP, 0.0, LARGEST_STEP])
    off = noise.log_factor - start.log_factor
    system = System(problem)
    changed = [system.with_problem(problem.with_heading_noise(float(np.exp(step)))) for step in steps]
    logs = np.array(
        [log_posterior(off + step, at.solve(fit, STEPS), at) for step, at in zip(steps, changed, strict=True)]
    )
    if not np.isfinite(logs).all():
        return noise
    slope = (logs[2] - logs[0]) / (2 * LARGEST_STEP)
    bend = (logs[0] - 2 * logs[1] + logs[2]) / LARGEST_STEP**2
    curved = bend < 0  # else there is no maximum near by
    step = -slope / bend if curved else np.sign(slope) * LARGEST_STEP
    moved = noise.log_factor + float(np.clip(step, -LARGEST_STEP, LARGEST_STEP))
    return HeadingNoise(max(moved, least), float(1 / np.sqrt(-bend)) if curved else SPREAD)


def log_posterior(off: float, fit: MapFit, system: System) -> float:
    """Log probability of the noise of `system`, and of odometry and closures with it, up to a constant.

    Args:
        off: log of the noise less that of the first map. fit: that solves the system.
    """
    return -0.5 * (off / SPREAD) ** 2 + system.log_evidence(fit)
