"""The path of a rat, its poses at even times, and its odometry: the true motion with errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat

from robot.recordings.sanity_checks import RowName, clock_errors, nonfinite_errors
from robot.sources.input_files import raise_errors
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.settings import Settings

SPEED_WINDOW = 0.1
"""Shortest time over which a speed is measured, s: a tracker's jitter within it is not motion."""


class RatPath(NamedTuple):
    """Positions of a rat.

    Attributes:
        time: [N] s, increasing. position: [N, 2] m. heading: [N] rad, or None: the direction of motion.
    """

    time: np.ndarray
    position: np.ndarray
    heading: np.ndarray | None = None


class MotionConfig(Settings):
    """What is a path of a rat, and its heading."""

    max_speed: PositiveFloat = 5.0
    """Largest speed over 0.1 s that is not an error, m/s; a sprinting rat reaches 2 to 3."""
    max_gap: PositiveFloat = 2.0
    """Longest time without a position that is interpolated, s."""
    smoothing: NonNegativeFloat = 0.1
    """Standard deviation of the Gaussian that smooths positions read from a file, s."""
    heading_smoothing: NonNegativeFloat = 0.15
    """Standard deviation of the Gaussian that smooths the heading, s."""
    standing: PositiveFloat = 0.03
    """Speed below which the rat stands and its heading holds, m/s."""


def check_path(path: RatPath, config: MotionConfig, place: RowName) -> None:
    """Checks a path.

    Raises:
        InputErrors: a value is not finite, times do not increase, a gap is too long, or a speed is beyond
            that of a rat.
    """
    time, position = path.time, path.position
    if len(time) < 2:
        raise InputError(place(0), f"{len(time)} positions", "two at least")
    values = [position] if path.heading is None else [position, path.heading]
    errors = nonfinite_errors(time, "t", place)
    errors += nonfinite_errors(np.column_stack(values), "the position", place)
    raise_errors(errors or clock_errors(time, "t", place))
    gap = np.diff(time)
    if gap.max() > config.max_gap:
        row, cure = int(gap.argmax()), "give max_gap in the section of the path, or cut the path there"
        found = f"no position for {gap[row]:.3g} s"
        raise InputError(place(row + 1), found, f"at most {config.max_gap:g} s", cure)
    later = np.searchsorted(time, time + SPEED_WINDOW - 1e-9)
    first = np.flatnonzero(later < len(time))
    later = later[first]
    speed = np.hypot(*(position[later] - position[first]).T) / (time[later] - time[first])
    fast = np.flatnonzero(speed > config.max_speed)
    if len(fast):
        found = f"a speed of {speed[fast[0]]:.3g} m/s"
        cure = "are the positions in metres and the times in seconds? max_speed sets the limit"
        raise InputError(place(int(later[fast[0]])), found, f"at most {config.max_speed:g} m/s", cure)


def sample_path(path: RatPath, config: MotionConfig, rate_hz: float, smoothing: float = 0.0) -> np.ndarray:
    """[M, 3] poses (m, m, rad) of a path from its first time on, at a rate; headings are not wrapped.

    Positions are interpolated by monotone cubics (PCHIP; Fritsch & Carlson 1980) and smoothed by a Gaussian;
    they stay within the bounds of the given ones. Without given headings, the heading is the direction of
    motion (`_heading_of_motion`).

    Args:
        smoothing: standard deviation of the Gaussian, s.
    """
    from scipy.interpolate import PchipInterpolator  # slow to import
    from scipy.ndimage import gaussian_filter1d

    start = path.time[0]
    count = int(np.floor((path.time[-1] - start) * rate_hz + 1e-6)) + 1
    time = np.minimum(start + np.arange(count) / rate_hz, path.time[-1])
    position = np.asarray(PchipInterpolator(path.time, path.position)(time))
    if smoothing:
        position = gaussian_filter1d(position, smoothing * rate_hz, axis=0, mode="nearest")
    if path.heading is None:
        heading = _heading_of_motion(position, config, rate_hz)
    else:
        heading = np.interp(time, path.time, np.unwrap(path.heading))
    return np.column_stack([position, heading])


def _heading_of_motion(position: np.ndarray, config: MotionConfig, rate_hz: float) -> np.ndarray:
    """[M] heading, rad, not wrapped, of positions [M, 2] at a rate: the direction of motion.

    While the rat is slower than `standing`, the direction holds, before its first motion that of the first
    motion. The direction is then unwrapped, so that a turn is shorter than half a turn, and smoothed by a
    Gaussian of `heading_smoothing`, which spreads the turn of a rat that starts anew over about three of its
    standard deviations.
    """
    if len(position) < 2:
        return np.zeros(len(position))
    velocity = np.gradient(position, axis=0) * rate_hz
    moving = np.hypot(*velocity.T) >= config.standing
    if not moving.any():
        return np.zeros(len(position))
    last = np.maximum.accumulate(np.where(moving, np.arange(len(position)), -1))
    last = np.where(last < 0, int(moving.argmax()), last)
    heading = np.unwrap(np.arctan2(velocity[last, 1], velocity[last, 0]))
    if not config.heading_smoothing:
        return heading
    from scipy.ndimage import gaussian_filter1d  # slow to import

    return gaussian_filter1d(heading, config.heading_smoothing * rate_hz, mode="nearest")


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
