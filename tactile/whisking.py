"""Whisking control: a sinusoidal protraction whose amplitude is reduced by contact.

One pure function for simulated and real heads. The command is the protraction
    amplitude (1 - cos(2 pi rate t)) / 2,
which starts at rest in every cycle; feedback changes only the amplitude (Salman & Pearson 2016, III-E).
"""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from tactile.base.errors import InputError
from tactile.base.settings import Settings
from tactile.base.types import Array
from tactile.whisker_geometry import Head

MID_PROTRACTION = 0.25
"""Phase of a whisk (share of its period) at which its pose and time stamp are taken: mid-protraction."""


class WhiskingConfig(Settings):
    """Whisking control."""

    mode: Literal["open", "rcp", "spread"] = "rcp"
    """`open`: the sinusoid without feedback; `rcp`: contact lowers the amplitude (rapid cessation of
    protraction); `spread`: neighbours of a whisker in contact also lower theirs (spread reduction)."""
    rate: PositiveFloat = 1.0
    """Whisks per second."""
    amplitude_deg: Annotated[float, Field(gt=0, le=180)] = 65.0
    """Amplitude of the protraction."""
    gain: NonNegativeFloat = 4.0
    """Reduction of the amplitude per deflection above the contact threshold, rad per rad."""
    window: PositiveFloat = 0.01
    """Time constant of the mean deflection, s."""
    follow: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Share of the amplitude reduction that free neighbours of a whisker in contact follow, in `spread`.
    Larger values cost contacts: in a micromouse maze 3 % at 0.2, 40 % at 0.5."""


class WhiskDrive(NamedTuple):
    """State of the control within a cycle.

    Attributes:
        time: of the last sample, s since the cycle began. mean: [..., W] running mean of |y|, rad.
        most: [..., W] largest perturbation so far, rad; the amplitude stays reduced until the cycle ends,
            since a whisker that springs back would hit the wall again.
    """

    time: float
    mean: np.ndarray
    most: np.ndarray


def initial_drive(*shape: int) -> WhiskDrive:
    """The state of whiskers [..., W] before their first cycle."""
    return WhiskDrive(0.0, np.zeros(shape), np.zeros(shape))


def whisk_phase(config: WhiskingConfig, time: Array) -> np.ndarray:
    """Commanded share of the amplitude at times (s since the cycle began): 0 at rest, 1 at the peak."""
    return (1 - np.cos(2 * np.pi * config.rate * np.asarray(time, float))) / 2


def whisk_command(
    config: WhiskingConfig,
    drive: WhiskDrive,
    time: float,
    deflection: np.ndarray,
    threshold: np.ndarray,
    shape: tuple[int, int],
) -> tuple[np.ndarray, WhiskDrive]:
    """Commanded protractions; called once per sample, with any axes before that of the whiskers.

    The perturbation is the mean of |y| above the contact threshold; `gain` times it lowers the amplitude. A
    time before the previous one starts a new cycle.

    Args:
        time: s since the cycle began. deflection: [..., W] newest y minus its free-whisking mean, rad.
        threshold: [W] contact threshold of y, rad. shape: rows and columns of the head.

    Returns:
        [..., W] protractions, rad, and the new state.
    """
    share = (1 - np.cos(2 * np.pi * config.rate * time)) / 2
    amplitude = np.radians(config.amplitude_deg)
    if config.mode == "open":
        return np.full(np.shape(deflection), amplitude * share), drive._replace(time=time)
    last, mean, most = drive
    if time < last:
        last, mean, most = 0.0, np.zeros_like(mean), np.zeros_like(most)
    mean = mean + (1 - np.exp((last - time) / config.window)) * (np.abs(deflection) - mean)
    most = np.maximum(most, mean - threshold)
    taken = most
    if config.mode == "spread":
        taken = np.where(most > 0, most, config.follow * neighbour_max(most, shape))
    return np.maximum(amplitude - config.gain * taken, 0.0) * share, WhiskDrive(time, mean, most)


def neighbour_max(value: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The largest value [..., W] among each whisker's neighbours: its column and the adjacent columns.

    The rows of a head with several are rings, so the last column is next to the first. Rats reduce the spread
    between whiskers with and without contact (Mitchinson & Prescott 2013); here all whiskers start together,
    so the spread is the difference of their amplitudes.
    """
    grid = value.reshape(*value.shape[:-1], *shape)
    near = np.broadcast_to(grid.max(axis=-2, keepdims=True), grid.shape).copy()
    if shape[0] > 1:
        near = np.maximum(near, np.maximum(np.roll(grid, 1, axis=-1), np.roll(grid, -1, axis=-1)))
    else:
        near[..., 1:] = np.maximum(near[..., 1:], grid[..., :-1])
        near[..., :-1] = np.maximum(near[..., :-1], grid[..., 1:])
    return near.reshape(value.shape)


def check_amplitude(config: WhiskingConfig, head: Head, where: str = "simulation.whisking") -> None:
    """Checks the amplitude against the head.

    Raises:
        InputError: the amplitude exceeds the head's limit.
    """
    if np.radians(config.amplitude_deg) > head.limit + 1e-9:
        found, most = f"{config.amplitude_deg:g} degrees", f"at most {np.degrees(head.limit):g}, limit_deg"
        cure = "lower the amplitude, or raise the limit if the drives allow it"
        raise InputError(f"{where}.amplitude_deg", found, most, cure)
