"""Wheel odometry of the Create: scale errors of 5 % (Fox et al. 2012, II-B), or those of real Creates."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat

from robot.sources.odometry import OdometryCorrection
from tactile.base.settings import Settings

BIAS_WHITE_SHARE = 0.2
"""White noise in addition to a bias, as a fraction of the level: 1 % with 5 %."""

TRUE_LENGTH, TRUE_TURN = 0.927, 0.950
"""Truth over odometry of real Creates, means of ten runs: their odometry is too long."""
LENGTH_SPREAD, TURN_SPREAD = 0.018, 0.021
"""Its standard deviations between runs."""
HEADING_DRIFT = (-0.22 / 60, 0.01 / 60)
"""Range over runs of the true heading's drift beyond the scale, rad/s, counter-clockwise."""
WINDOW, RUN_WINDOWS = 10.0, 75
"""Duration of the windows that the errors within a run were measured over, s, and their number in a run."""
WINDOW_LENGTH, WINDOW_TURN = (0.10, 0.14), (0.125, 0.16)
"""Ranges over runs of the standard deviation of a window's error, as a share of its distance and of its turn
(0.10 to 0.17 rad in windows that turned by 0.8 to 1.05 rad)."""


MEAN_ERRORS = OdometryCorrection(length_scale=TRUE_LENGTH, turn_scale=TRUE_TURN)
"""What takes the mean scale errors of real Creates out of an odometry; the rest of a run's own remains."""


class WheelsConfig(Settings):
    """Errors of wheel odometry, independent for lengths and turns."""

    noise: Literal["white", "move", "bias", "measured", "none"] = "move"
    """`white`: a new error in every step; `move`: one for each straight or turn; `bias`: one for the whole
    session, plus a fifth of it anew in every step; `measured`: as five real Creates of Leung et al. 2011, too
    long by 7 %, with turns too large by 5 %, a heading drift, and an error anew every 10 s."""
    level: NonNegativeFloat = 0.05
    """Standard deviation of the scale error, except for `measured`."""


def simulate_wheel_odometry(
    config: WheelsConfig, motion: np.ndarray, kind: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """Odometry [N, 4] (dx m, dy m, dtheta rad, dt s) with errors.

    Args:
        motion: [N, 4] true motion. kind: [N] `MotionKind` of each step.
    """
    count = len(motion)
    measured = np.array(motion, np.float64)
    if config.noise == "none" or not count:
        return measured
    if config.noise == "measured":
        return _measured_odometry(measured, random)
    # All errors are drawn for each of these kinds of noise, so that the random streams agree.
    white, run = random.standard_normal((count, 2)), random.standard_normal(2)
    if config.noise == "white":
        error = white
    elif config.noise == "move":
        begins = np.concatenate([[True], kind[1:] != kind[:-1]])
        error = white[np.flatnonzero(begins)[np.cumsum(begins) - 1]]
    else:
        error = run + BIAS_WHITE_SHARE * white
    scale = 1 + config.level * error
    measured[:, :2] *= scale[:, :1]
    measured[:, 2] *= scale[:, 1]
    return measured


def _measured_odometry(motion: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Odometry [N, 4] of true motions [N, 4] with the errors of five Creates in ten runs (MRCLAM 6 and 7).

    Leung, Halpern, Barfoot & Liu: The UTIAS multi-robot cooperative localization and mapping dataset, IJRR
    2011; odometry there is commanded velocity. What is known of the errors within a run is their spread over
    windows of 10 s, so one error holds for each window.
    """
    window = random.uniform(*np.transpose([WINDOW_LENGTH, WINDOW_TURN]))
    # The windows' errors leave a part in the mean of a run, which is not to be counted twice.
    left = np.mean([WINDOW_LENGTH, WINDOW_TURN], axis=1) ** 2 / RUN_WINDOWS
    run = np.sqrt(np.square([LENGTH_SPREAD, TURN_SPREAD]) - left) * random.standard_normal(2)
    drift = random.uniform(*HEADING_DRIFT)
    time = np.concatenate([[0.0], np.cumsum(motion[:-1, 3])])
    number = (time / WINDOW).astype(int)
    error = window * random.standard_normal((number[-1] + 1, 2))[number]
    scale = (1 + error) / (np.array([TRUE_LENGTH, TRUE_TURN]) + run)
    motion[:, 2] -= drift * motion[:, 3]
    motion[:, :2] *= scale[:, :1]
    motion[:, 2] *= scale[:, 1]
    return motion
