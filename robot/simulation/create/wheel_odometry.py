"""Wheel odometry of the Create: scale errors of 5 % of every straight or turn (Fox et al. 2012, II-B)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat

from tactile.base.config import Settings

BIAS_WHITE_SHARE = 0.2
"""White noise in addition to a bias, as a fraction of the level: 1 % with 5 %."""


class WheelsConfig(Settings):
    """Errors of wheel odometry, independent for lengths and turns."""

    noise: Literal["white", "move", "bias", "none"] = "move"
    """`white`: a new error in every step; `move`: one for each straight or turn; `bias`: one for the whole
    session, plus a fifth of it anew in every step."""
    level: NonNegativeFloat = 0.05
    """Standard deviation of the scale error."""


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
    # All errors are drawn for every kind of noise, so that the random streams agree.
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
