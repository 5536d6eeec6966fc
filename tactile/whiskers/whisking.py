"""How whiskers are driven: a sinusoid, and what contact makes of its amplitude.

One pure law, for simulated and real heads alike. The command is a protraction
    amplitude (1 - cos(2 pi rate t)) / 2,
which starts at rest in every cycle; feedback lowers the amplitude only, so the start stays where it is
(Salman & Pearson 2016, III-E).
"""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from tactile.base.config import Settings
from tactile.base.errors import InputError
from tactile.base.types import Array
from tactile.whiskers.head_geometry import Head

MID_PROTRACTION = 0.25
"""Phase of a whisk (share of its period) at which its pose and time stamp are taken: mid-protraction."""


class WhiskingConfig(Settings):
    """One whisker's drive."""

    mode: Literal["open", "rcp", "spread"] = "rcp"
    """`open`: the sinusoid; `rcp`: contact lowers the amplitude (rapid cessation of protraction); `spread`:
    and whiskers beside one that touched follow it (spread reduction)."""
    rate: PositiveFloat = 1.0
    """Whisks per second."""
    amplitude_deg: Annotated[float, Field(gt=0, le=180)] = 65.0
    """Of the protraction."""
    gain: NonNegativeFloat = 4.0
    """Amplitude taken off for each unit of deflection above the contact threshold, rad per rad."""
    window: PositiveFloat = 0.01
    """Time over which the deflection is averaged, s."""
    follow: Annotated[float, Field(ge=0, le=1)] = 0.2
    """Share of a touching whisker's loss of amplitude that free ones beside it take over, in `spread`. More
    takes contacts from them: in a micromouse maze 3 % at 0.2, 40 % at 0.5."""


class WhiskDrive(NamedTuple):
    """What the law remembers of the cycle so far.

    Attributes:
        time: s in the cycle, of the last sample. mean: [..., W] running mean of the size of y, rad.
        most: [..., W] the largest perturbation so far, rad: amplitude that was taken off stays off until the
            cycle ends, for a whisker that sprang back would knock on the wall.
    """

    time: float
    mean: np.ndarray
    most: np.ndarray


def initial_drive(*shape: int) -> WhiskDrive:
    """The drives of whiskers [..., W] before their first cycle."""
    return WhiskDrive(0.0, np.zeros(shape), np.zeros(shape))


def whisk_phase(config: WhiskingConfig, time: Array) -> np.ndarray:
    """Share of the amplitude commanded at each time, s: 0 at rest, 1 at full protraction."""
    return (1 - np.cos(2 * np.pi * config.rate * np.asarray(time, float))) / 2


def whisk_command(
    config: WhiskingConfig,
    drive: WhiskDrive,
    time: float,
    deflection: np.ndarray,
    threshold: np.ndarray,
    shape: tuple[int, int],
) -> tuple[np.ndarray, WhiskDrive]:
    """Where the whiskers are to go now; called once a sample, with any axes before that of the whiskers.

    The perturbation is the mean size of y in excess of the contact threshold; `gain` times it lowers the
    amplitude. A time before the last one begins a new cycle.

    Args:
        time: s since the cycle began. deflection: [..., W] the newest y, less its mean in free whisking, rad.
        threshold: [W] contact threshold of y, rad. shape: rows and columns of the head.

    Returns:
        [..., W] protractions, rad, and the drives after it.
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
    taken = (
        most if config.mode == "rcp" else np.where(most > 0, most, config.follow * neighbour_max(most, shape))
    )
    return np.maximum(amplitude - config.gain * taken, 0.0) * share, WhiskDrive(time, mean, most)


def neighbour_max(value: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """[..., W] the largest value among each whisker's neighbours: its column, and the two next to it.

    Rows of a head with several are rings, whose ends meet. In rats, whiskers that do not touch lessen their
    spread towards those that do (Mitchinson & Prescott 2013); all of ours start together, so the spread is
    the difference of amplitudes, and they follow by giving up part of theirs.
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
    """Refuse what the drives cannot do.

    Raises:
        InputError: the amplitude is beyond their limit.
    """
    if np.radians(config.amplitude_deg) > head.limit + 1e-9:
        raise InputError(
            f"{where}.amplitude_deg",
            f"{config.amplitude_deg:g} degrees",
            f"at most {np.degrees(head.limit):g}, the head's limit_deg",
            "lower the amplitude, or raise the limit if the drives allow it",
        )
