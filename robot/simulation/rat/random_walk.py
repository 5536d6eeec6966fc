"""A random walk of a rat in a box: Ornstein-Uhlenbeck speed and turning, drawn to the walls.

After Raudies & Hasselmo 2012 and RatInABox (George et al. 2024), whose means and times the defaults are.
"""

from __future__ import annotations

from math import atan2, cos, exp, pi, sin
from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from robot.simulation.rat.rat_path import RatPath
from tactile.base.config import Settings
from tactile.base.random_streams import stream

STEER = 8.0
"""Rate at which the rat turns from a wall that it touches, 1/s, as a share of the angle left."""


class RandomWalkConfig(Settings):
    """A random walk."""

    speed: PositiveFloat = 0.16
    """Mean speed, m/s."""
    speed_sd: PositiveFloat = 0.084
    """Standard deviation of the speed, m/s; 0.52 of the mean resembles a Rayleigh distribution."""
    speed_time: PositiveFloat = 0.7
    """Correlation time of the speed, s."""
    turn_sd: NonNegativeFloat = 2.1
    """Standard deviation of the turn rate, rad/s."""
    turn_time: PositiveFloat = 0.08
    """Correlation time of the turn rate, s."""
    wall_distance: NonNegativeFloat = 0.1
    """Distance from which a wall acts on the direction, m."""
    thigmotaxis: Annotated[float, Field(ge=0, le=1)] = 0.5
    """How far the rat follows walls: 1: it turns along a wall, 0: straight away from it."""


def walk_randomly(
    config: RandomWalkConfig, size: tuple[float, float], seconds: float, rate_hz: float, seed: int
) -> RatPath:
    """A walk in a box of a size (m, m) with a corner at the origin, from its middle.

    Speeds have a gamma distribution of the given mean and standard deviation: the quantiles of a normal
    Ornstein-Uhlenbeck process. A longer walk of the same seed begins with the shorter one.
    """
    from scipy.stats import gamma, norm  # slow to import

    count = int(np.ceil(seconds * rate_hz)) + 1
    draws = stream(seed, "rat walk").standard_normal((count, 2))
    z = ornstein_uhlenbeck(draws, np.array([config.speed_time, config.turn_time]), 1 / rate_hz)
    spread = config.speed_sd**2 / config.speed
    speed = gamma.ppf(norm.cdf(z[:, 0]), config.speed / spread, scale=spread)
    turn = config.turn_sd * z[:, 1]
    position = _walk(config, size, speed / rate_hz, turn / rate_hz, 1 / rate_hz)
    return RatPath(np.arange(count) / rate_hz, position)


def ornstein_uhlenbeck(draws: np.ndarray, time: np.ndarray, step: float) -> np.ndarray:
    """[N, D] stationary processes of variance 1 from normal draws [N, D], for correlation times [D], s."""
    keep = np.exp(-step / time)
    fresh = np.sqrt(1 - keep**2)
    values = np.empty_like(draws)
    values[0] = draws[0]
    for row in range(1, len(draws)):
        values[row] = keep * values[row - 1] + fresh * draws[row]
    return values


def _walk(
    config: RandomWalkConfig, size: tuple[float, float], steps: np.ndarray, turns: np.ndarray, dt: float
) -> np.ndarray:
    """[N, 2] positions after steps [N], m, and turns [N], rad; walls reflect."""
    (width, height), steer = size, 1 - exp(-STEER * dt)
    x, y, heading = width / 2, height / 2, 0.0
    position = np.empty((len(steps), 2))
    for row, (step, turn) in enumerate(zip(steps.tolist(), turns.tolist(), strict=True)):
        position[row] = x, y
        heading += turn
        for distance, outward in ((x, pi), (width - x, 0.0), (y, -pi / 2), (height - y, pi / 2)):
            heading += steer * _turn_at_wall(config, distance, heading - outward)
        x, mirrored = _reflect(x + step * cos(heading), width)
        if mirrored:
            heading = pi - heading
        y, mirrored = _reflect(y + step * sin(heading), height)
        if mirrored:
            heading = -heading
    return position


def _turn_at_wall(config: RandomWalkConfig, distance: float, heading: float) -> float:
    """Turn that a wall asks for, rad: from a heading relative to its outward normal to one along it, or away
    from it; 0 for a rat that is farther than `wall_distance` or already leaves."""
    if distance >= config.wall_distance:
        return 0.0
    heading = atan2(sin(heading), cos(heading))
    wanted = pi / 2 + (1 - config.thigmotaxis) * pi / 2
    if abs(heading) >= wanted:
        return 0.0
    turn = wanted - abs(heading)
    return (1 - distance / config.wall_distance) * (turn if heading >= 0 else -turn)


def _reflect(value: float, size: float) -> tuple[float, bool]:
    """A coordinate mirrored at the walls at 0 and `size`, and whether it was."""
    if 0 <= value <= size:
        return value, False
    folded = value % (2 * size)
    return min(folded, 2 * size - folded), True
