"""The kinematic tier: whisk cycles in closed form, without a stream of samples.

The head is looked at in a few poses along each protraction. A whisker meets the first obstacle on its way;
from there its drive pushes on against it: of what is commanded beyond the contact, a stiff drive bends the
whisker by the share `servo / (1 + servo)`. A whisker bent too far slips off.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from robot.world.head_trajectory import HeadPath, poses_at
from robot.world.walls import Surroundings
from tactile.base.config import Settings
from tactile.base.types import Odometry, Whisk
from tactile.features.contact import ShaftConfig, stiffness
from tactile.whiskers.head_geometry import Head
from tactile.whiskers.whisking import WhiskingConfig, neighbour_max, whisk_phase

SHAFT = ShaftConfig()
"""Of all whiskers."""
MIN_REACH = 0.05
"""Reach, as a share of the shaft, under which a contact counts as this far out."""
HEEDED_SDS = 20.0
"""Noise that a reading must exceed for the whisking law to heed it, in standard deviations (the paper's)."""
MEAN_NOISE_SHARE = 0.3
"""Noise of the largest angle, which is a mean over 10 ms, as a share of one sample's."""


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


class WhiskColumns(NamedTuple):
    """What every whisker felt in every cycle: the columns [N, W] of `Whisk`."""

    contact: np.ndarray
    touched: np.ndarray
    held: np.ndarray
    highest: np.ndarray
    reach: np.ndarray


def simulate_kinematic(
    config: MechanicsConfig,
    whisking: WhiskingConfig,
    surroundings: Surroundings,
    path: HeadPath,
    start: np.ndarray,
    random: np.random.Generator,
) -> WhiskColumns:
    """Whisk cycles that start at times [N] s along a path."""
    met = _met(config, whisking, surroundings, path, start)
    felt = _pushed(config, whisking, surroundings.head, met)
    return _sensed(config, whisking, surroundings.head, felt, random)


class _Met(NamedTuple):
    """What whiskers meet [N, W]: whether anything on their way, the protraction at which, where along the
    shaft, and the same two (infinite where free) at the end of the protraction."""

    contact: np.ndarray
    touched: np.ndarray
    reach: np.ndarray
    last: np.ndarray
    last_reach: np.ndarray


def _met(
    config: MechanicsConfig,
    whisking: WhiskingConfig,
    surroundings: Surroundings,
    path: HeadPath,
    start: np.ndarray,
) -> _Met:
    whiskers, count = len(surroundings.head.length), len(start)
    amplitude = np.radians(whisking.amplitude_deg)
    lag = (np.arange(config.poses) + 1) / config.poses / (2 * whisking.rate)
    command, midway = (
        amplitude * whisk_phase(whisking, lag),
        amplitude * whisk_phase(whisking, lag - lag[0] / 2),
    )
    met = surroundings.contact(poses_at(path, start[:, None] + lag).reshape(-1, 3))
    wall, along, box = (column.reshape(count, config.poses, whiskers) for column in met)
    touches = wall <= command[:, None]
    contact, first = touches.any(axis=1), np.argmax(touches, axis=1)

    def then(column: np.ndarray, row: np.ndarray) -> np.ndarray:
        return np.take_along_axis(column, row[:, None], axis=1)[:, 0]

    # A wall that the head's own motion brought into the sweep is met where the whisker is by then: about
    # half-way between two poses. That it was met late stays for the whole cycle.
    new = (first > 0) & (then(box, np.maximum(first - 1, 0)) != then(box, first))
    before = np.concatenate([[0.0], command[:-1]])
    stands = np.where(contact, then(wall, first), 0.0)
    touched = np.where(contact, np.maximum(stands, np.where(new, midway[first], before[first])), 0.0)
    reach = np.where(contact, np.maximum(then(along, first), MIN_REACH), 1.0)
    last = wall[:, -1] + touched - stands
    return _Met(contact, touched, reach, last, np.where(np.isfinite(last), along[:, -1], 1.0))


def _pushed(config: MechanicsConfig, whisking: WhiskingConfig, head: Head, met: _Met) -> WhiskColumns:
    """What the drives make of it: how far whiskers bend and turn. A whisker touched near its base is stiffer:
    it bends less and its sensor reads more."""
    amplitude = np.radians(whisking.amplitude_deg)
    hard = stiffness(SHAFT, met.reach)
    push = hard * config.servo / (config.servo + hard)  # reading for each radian commanded beyond contact
    reading = np.where(met.contact, push * (amplitude - met.touched), 0.0)
    reading, taken = _fed_back(config, whisking, head, reading, push)
    there = np.isfinite(met.last)
    last = np.where(there, met.last, 0.0)
    hard_last = stiffness(SHAFT, np.maximum(met.last_reach, MIN_REACH))
    bend = np.where(there, config.servo / (config.servo + hard_last) * (amplitude - taken - last), 0.0)
    noticed = met.contact & (np.maximum(reading, hard_last * bend) > config.dead_zone)
    # Slip is a matter of the angle at the end; whether contact still shows then, of the reading.
    held = noticed & there & (bend <= config.slip) & (hard_last * bend > config.dead_zone)
    highest = np.where(held, last + bend, amplitude - taken)
    return WhiskColumns(
        noticed, np.where(noticed, met.touched + config.dead_zone, 0.0), held, highest, met.reach
    )


def _fed_back(
    config: MechanicsConfig, whisking: WhiskingConfig, head: Head, reading: np.ndarray, push: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Readings [N, W] and the amplitude taken off, rad, once the whisking law has had its say: what exceeds
    the contact threshold lowers the amplitude, which lowers the reading, and so on to the balance."""
    if whisking.mode == "open":
        return reading, np.zeros_like(reading)
    limit, gain = HEEDED_SDS * config.noise, whisking.gain
    over = reading > limit
    reading = np.where(over, (reading + push * gain * limit) / (1 + push * gain), reading)
    taken = gain * np.maximum(reading - limit, 0.0)
    if whisking.mode == "spread":
        led = taken == 0
        taken = np.where(led, whisking.follow * neighbour_max(taken, head.shape), taken)
        reading = np.where(led, np.maximum(reading - push * taken, 0.0), reading)
    return reading, taken


def _sensed(
    config: MechanicsConfig,
    whisking: WhiskingConfig,
    head: Head,
    felt: WhiskColumns,
    random: np.random.Generator,
) -> WhiskColumns:
    """With the sensors' noise and faults."""
    shape, alive = felt.contact.shape, head.alive
    missed = random.random(shape) < config.missed
    spurious = ~felt.contact & (random.random(shape) < config.spurious)
    anywhere = random.random(shape) * np.radians(whisking.amplitude_deg)
    noise = (
        config.noise * random.standard_normal((2, *shape)) * np.array([1.0, MEAN_NOISE_SHARE])[:, None, None]
    )
    smeared = config.reach_noise * random.standard_normal(shape)
    contact = ((felt.contact & ~missed) | spurious) & alive
    touched = np.where(spurious, anywhere, felt.touched)
    highest = np.where(spurious, anywhere, felt.highest + noise[1])
    return WhiskColumns(
        contact=contact,
        touched=np.where(contact, touched + noise[0], 0.0),
        held=((felt.held & ~missed) | spurious) & alive,
        highest=np.where(alive, highest, 0.0),
        reach=np.where(contact, np.clip(felt.reach + smeared, 0.0, 1.0), 0.0),
    )


def whisk_of_row(head: Head, felt: WhiskColumns, row: int, odometry: Odometry) -> Whisk:
    """One cycle of them."""
    return Whisk(odometry, head.alive, *(column[row] for column in felt))
