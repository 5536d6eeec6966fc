"""Odometry of a rat: its true motion with errors of speed and heading."""

from __future__ import annotations

import numpy as np
from pydantic import NonNegativeFloat

from tactile.base.random_streams import stream
from tactile.base.settings import Settings


class RatOdometryConfig(Settings):
    """Errors of path integration. Each is independent of the rate; the defaults are of no particular rat."""

    speed_white: NonNegativeFloat = 0.1
    """White error of the speed, as a share of it over one second, sqrt(s): after t seconds at v m/s the
    distance has a standard deviation of v sqrt(t) times this."""
    speed_scale: float = 0.0
    """Constant error of the speed, as a share of it: 0.05 is 5 % too fast."""
    heading_white: NonNegativeFloat = 0.02
    """White error of the heading, rad/sqrt(s)."""
    heading_bias: float = 0.0
    """Constant error of the turn rate, rad/s, counter-clockwise."""


def measure_motion(config: RatOdometryConfig, motion: np.ndarray, seed: int) -> np.ndarray:
    """Odometry [N, 4] (dx m, dy m, dtheta rad, dt s) of true motions [N, 4], with errors.

    The errors of speed and heading have random streams of their own, so that a change of one leaves the draws
    of the other. A row of no duration has no error.
    """
    speed = stream(seed, "rat speed noise").standard_normal(len(motion))
    heading = stream(seed, "rat heading noise").standard_normal(len(motion))
    measured = np.array(motion, np.float64)
    root = np.sqrt(motion[:, 3])
    share = config.speed_white * speed / np.where(root > 0, root, np.inf)
    measured[:, :2] *= (1 + config.speed_scale + share)[:, None]
    measured[:, 2] += config.heading_white * heading * root + config.heading_bias * motion[:, 3]
    return measured
