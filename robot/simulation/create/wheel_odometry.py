"""What the Create's wheels tell of its motion: to 5 % of any straight line or turn on the spot
(Fox et al. 2012, II-B). All errors are of scale: what does not move is known to stand."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import NonNegativeFloat

from tactile.base.config import Settings

BIAS_WHITE_SHARE = 0.2
"""White noise beside a bias, as a share of the level: 1 % beside 5 %."""


class WheelsConfig(Settings):
    """Errors of wheel odometry, of lengths and of turns, each by itself."""

    noise: Literal["white", "move", "bias", "none"] = "move"
    """`white`: in every step anew; `move`: one error for each straight line or turn, drawn anew when what is
    done changes; `bias`: one for the whole run, and a fifth as much in every step."""
    level: NonNegativeFloat = 0.05
    """Standard deviation of the scale."""


def simulate_wheel_odometry(
    config: WheelsConfig, motion: np.ndarray, kind: np.ndarray, random: np.random.Generator
) -> np.ndarray:
    """[N, 4] (dx m, dy m, dtheta rad, dt s) as the wheels tell it.

    Args:
        motion: [N, 4] the same, true. kind: [N] a `Motion` of each step.
    """
    count = len(motion)
    told = np.array(motion, np.float64)
    if config.noise == "none" or not count:
        return told
    # All are drawn whatever the noise is, so that two structures differ in nothing else.
    white, run = random.standard_normal((count, 2)), random.standard_normal(2)
    if config.noise == "white":
        error = white
    elif config.noise == "move":
        begins = np.concatenate([[True], kind[1:] != kind[:-1]])
        error = white[np.flatnonzero(begins)[np.cumsum(begins) - 1]]
    else:
        error = run + BIAS_WHITE_SHARE * white
    scale = 1 + config.level * error
    told[:, :2] *= scale[:, :1]
    told[:, 2] *= scale[:, 1]
    return told
