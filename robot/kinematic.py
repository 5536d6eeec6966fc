"""The kinematic tier: whisk cycles in closed form, without a stream of samples.

The head is looked at in a few poses along each protraction. A whisker meets the first obstacle on its way;
from there its drive pushes on against it: of what is commanded beyond the contact, a stiff drive bends the
whisker by the share `servo / (1 + servo)`. A whisker bent too far slips off.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from robot.motion import Path, at
from robot.walls import Surroundings
from tactile.head import Head
from tactile.settings import Settings
from tactile.types import Odometry, Whisk
from tactile.whisking import WhiskingConfig, phase


class MechanicsConfig(Settings):
    """Drives, whiskers and sensors of the simulated head; the paper gives none of these."""

    servo: PositiveFloat = 1.0
    """Stiffness of a drive over that of its whisker."""
    slip: PositiveFloat = 0.25
    """Deflection at which a whisker slips off, rad."""
    noise: NonNegativeFloat = 2e-3
    """Standard deviation of angles and deflections, rad."""
    dead_zone: NonNegativeFloat = 0.015
    """Deflection that passes unnoticed, rad."""
    missed: NonNegativeFloat = 0.0
    """Share of contacts that are missed."""
    spurious: NonNegativeFloat = 0.0
    """Share of free whiskers that report one."""
    reach_noise: NonNegativeFloat = 0.1
    """Standard deviation of the radial distance, as a share of the whisker's length."""
    poses: PositiveInt = 8
    """Of the head along a protraction, at which contact is looked for."""


class Felt(NamedTuple):
    """What every whisker felt in every cycle: the columns [N, W] of `Whisk`."""

    contact: np.ndarray
    touched: np.ndarray
    held: np.ndarray
    highest: np.ndarray
    reach: np.ndarray


def felt(
    config: MechanicsConfig,
    whisking: WhiskingConfig,
    surroundings: Surroundings,
    path: Path,
    start: np.ndarray,
    random: np.random.Generator,
) -> Felt:
    """Whisk cycles that start at times [N] s along a path."""
    head = surroundings.head
    amplitude = np.radians(whisking.amplitude_deg)
    whiskers, count = len(head.length), len(start)
    lag = (np.arange(config.poses) + 1) / config.poses / (2 * whisking.rate)
    command = amplitude * phase(whisking, lag)
    met = surroundings.contact(at(path, start[:, None] + lag).reshape(-1, 3))
    wall = met.angle.reshape(count, config.poses, whiskers)
    along = met.reach.reshape(count, config.poses, whiskers)

    before = np.concatenate([[0.0], command[:-1]])
    touches = wall <= command[:, None]
    contact = touches.any(axis=1)
    first = np.argmax(touches, axis=1)
    touched = np.take_along_axis(wall, first[:, None], axis=1)[:, 0]
    reach = np.take_along_axis(along, first[:, None], axis=1)[:, 0]
    # A wall that the head's own motion brought into the sweep is met where the whisker is by then.
    touched = np.where(contact, np.maximum(touched, before[first]), 0.0)

    push = config.servo / (1 + config.servo)
    if whisking.mode != "open":
        push = push / (1 + push * whisking.gain)
    last = wall[:, -1]
    bend = np.where(np.isfinite(last), push * (amplitude - np.where(np.isfinite(last), last, 0.0)), 0.0)
    held = contact & np.isfinite(last) & (bend <= config.slip) & (last < amplitude)
    # The bend at which contact shows: all of it, also of a whisker that slips off later.
    bent = np.where(contact, push * (amplitude - touched), 0.0)
    noticed = contact & (np.maximum(bend, bent) > config.dead_zone)

    missed = random.random((count, whiskers)) < config.missed
    spurious = ~contact & (random.random((count, whiskers)) < config.spurious)
    anywhere = random.random((count, whiskers)) * amplitude
    noise = config.noise * random.standard_normal((2, count, whiskers))
    smeared = config.reach_noise * random.standard_normal((count, whiskers))
    contact = (noticed & ~missed) | spurious
    touched = np.where(spurious, anywhere, touched + config.dead_zone)
    held = held & noticed & ~missed
    highest = np.where(held, last + bend, amplitude) + noise[1]
    alive = head.alive
    return Felt(
        contact=contact & alive,
        touched=np.where(contact & alive, touched + noise[0], 0.0),
        held=(held | spurious) & alive,
        highest=np.where(alive, np.where(spurious, touched, highest), 0.0),
        reach=np.where(contact & alive, np.clip(np.where(spurious, 1.0, reach) + smeared, 0.0, 1.0), 0.0),
    )


def whisk(head: Head, felt: Felt, row: int, odometry: Odometry) -> Whisk:
    """One cycle of them."""
    return Whisk(odometry, head.alive, *(column[row] for column in felt))
