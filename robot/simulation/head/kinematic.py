"""The kinematic fidelity: contact features of whisk cycles in closed form, without raw samples.

Contacts are computed at a few head poses along each protraction. From the first contact on, the drive bends
the whisker by the fraction `servo / (1 + servo)` of the commanded angle beyond it. A whisker bent beyond
the limit slips off.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from robot.simulation.head.baseline import BaselineConfig
from robot.simulation.head.beam import StreamConfig
from robot.sources.in_memory import NO_ODOMETRY
from robot.world.scene import HeadPath, poses_at
from robot.world.walls import Surroundings
from tactile.base.settings import Settings
from tactile.base.types import Whisk
from tactile.contact_threshold import ShaftConfig, stiffness
from tactile.whisker_geometry import Head
from tactile.whisking import WhiskingConfig, neighbour_max, whisk_phase

SHAFT = ShaftConfig()
"""Shaft of all whiskers."""
MIN_REACH = 0.05
"""Smallest reach of a contact, as a fraction of the shaft."""
HEEDED_SDS = 20.0
"""Threshold of the whisking law, in standard deviations of the noise (Salman & Pearson 2016)."""
MEAN_NOISE_SHARE = 0.3
"""Noise of the largest angle, a mean over 10 ms, as a fraction of that of one sample."""


class MechanicsConfig(Settings):
    """Drives, whiskers and sensors of the simulated head; the paper gives no values."""

    servo: PositiveFloat = 1.0
    """Ratio of drive stiffness to whisker stiffness."""
    slip: PositiveFloat = 0.25
    """Deflection at which a whisker slips off, rad."""
    noise: NonNegativeFloat = 2e-3
    """Standard deviation of angles and deflections, rad."""
    dead_zone: NonNegativeFloat = 0.015
    """Largest undetected deflection, rad."""
    missed: NonNegativeFloat = 0.0
    """Fraction of missed contacts."""
    spurious: NonNegativeFloat = 0.0
    """Fraction of free whiskers that report a contact."""
    reach_noise: NonNegativeFloat = 0.1
    """Standard deviation of the contact position along the shaft, as a fraction of its length."""
    poses: Annotated[int, Field(ge=1, le=1024)] = 8
    """Number of head poses per protraction at which contacts are computed."""
    baseline: BaselineConfig = BaselineConfig()
    """Coloured noise, drift and creep of the deflections; only the raw fidelities have them."""


class HeadSetup(NamedTuple):
    """Geometry of a simulated head, and the settings of its samples, mechanics and drives."""

    head: Head
    config: StreamConfig
    mechanics: MechanicsConfig
    whisking: WhiskingConfig


def simulate_kinematic(
    setup: HeadSetup,
    surroundings: Surroundings,
    path: HeadPath,
    start: np.ndarray,
    random: np.random.Generator,
) -> Whisk:
    """Contact features [N, W] of whisk cycles that start at times [N] s along a path, with noise and faults
    of the sensors; without odometry, and with one `alive` [W]."""
    features = _touch_walls(setup, surroundings, path, start)
    config, shape, alive = setup.mechanics, features.contact.shape, setup.head.alive
    missed = random.random(shape) < config.missed
    spurious = ~features.contact & (random.random(shape) < config.spurious)
    anywhere = random.random(shape) * np.radians(setup.whisking.amplitude_deg)
    noise = config.noise * random.standard_normal((2, *shape))
    noise = noise * np.array([1.0, MEAN_NOISE_SHARE])[:, None, None]
    smeared = config.reach_noise * random.standard_normal(shape)
    contact = ((features.contact & ~missed) | spurious) & alive
    touched = np.where(spurious, anywhere, features.touched)
    highest = np.where(spurious, anywhere, features.highest + noise[1])
    return Whisk(
        odometry=NO_ODOMETRY,
        alive=alive,
        contact=contact,
        touched=np.where(contact, touched + noise[0], 0.0),
        held=((features.held & ~missed) | spurious) & alive,
        highest=np.where(alive, highest, 0.0),
        reach=np.where(contact, np.clip(features.reach + smeared, 0.0, 1.0), 0.0),
    )


def _touch_walls(setup: HeadSetup, surroundings: Surroundings, path: HeadPath, start: np.ndarray) -> Whisk:
    """Contacts [N, W] with the walls, and how they bend and turn the whiskers, without noise.

    A whisker touched near its base is stiffer: it bends less and its sensor reads more.
    """
    head, _, config, whisking = setup
    whiskers, count = len(head.length), len(start)
    amplitude = np.radians(whisking.amplitude_deg)
    lag = (np.arange(config.poses) + 1) / config.poses / (2 * whisking.rate)
    command = amplitude * whisk_phase(whisking, lag)
    midway = amplitude * whisk_phase(whisking, lag - lag[0] / 2)
    met = surroundings.contact(poses_at(path, start[:, None] + lag).reshape(-1, 3))
    wall, along, box = (column.reshape(count, config.poses, whiskers) for column in met)
    touches = wall <= command[:, None]
    contact, first = touches.any(axis=1), np.argmax(touches, axis=1)

    def at_pose(column: np.ndarray, row: np.ndarray) -> np.ndarray:
        return np.take_along_axis(column, row[:, None], axis=1)[:, 0]

    # A wall that enters the sweep by the motion of the head makes contact at the whisker's angle then, about
    # half-way between two poses. The delay holds for the whole cycle.
    new = (first > 0) & (at_pose(box, np.maximum(first - 1, 0)) != at_pose(box, first))
    before = np.concatenate([[0.0], command[:-1]])
    stands = np.where(contact, at_pose(wall, first), 0.0)
    touched = np.where(contact, np.maximum(stands, np.where(new, midway[first], before[first])), 0.0)
    reach = np.where(contact, np.maximum(at_pose(along, first), MIN_REACH), 1.0)
    last = wall[:, -1] + touched - stands  # the wall at the end of the protraction, rad
    there = np.isfinite(last)

    hard = stiffness(SHAFT, reach)
    push = hard * config.servo / (config.servo + hard)  # reading for each radian commanded beyond contact
    reading = np.where(contact, push * (amplitude - touched), 0.0)
    reading, taken = _apply_feedback(setup, reading, push)
    last = np.where(there, last, 0.0)
    hard_last = stiffness(SHAFT, np.where(there, np.maximum(along[:, -1], MIN_REACH), 1.0))
    bend = np.where(there, config.servo / (config.servo + hard_last) * (amplitude - taken - last), 0.0)
    noticed = contact & (np.maximum(reading, hard_last * bend) > config.dead_zone)
    # Slip depends on the bend at the end; a contact is held if its reading still exceeds the dead zone.
    held = noticed & there & (bend <= config.slip) & (hard_last * bend > config.dead_zone)
    highest = np.where(held, last + bend, amplitude - taken)
    touched = np.where(noticed, touched + config.dead_zone, 0.0)
    return Whisk(NO_ODOMETRY, head.alive, noticed, touched, held, highest, reach)


def _apply_feedback(setup: HeadSetup, reading: np.ndarray, push: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Readings [N, W] and the reduction of the amplitude, rad, at the equilibrium of the whisking law: a
    reading above the contact threshold reduces the amplitude, which reduces the reading."""
    head, _, config, whisking = setup
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
