"""The calibration of the odometry: what a map starts from, and what a finished one knows."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ratslam.keyframes.config import KeyframeMapConfig
from ratslam.keyframes.odometry_noise import HeadingNoise
from ratslam.keyframes.optimizer import CalibrationPrior
from ratslam.keyframes.view_sectors import BiasEstimate

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
