"""The quasistatic fidelity: whiskers and drives in static equilibrium at every sample, with sensors and
feedback.

Of the commanded angle beyond the wall the whisker bends by the fraction servo / (servo + k), where k is its
stiffness at the contact relative to that at the reference. The sensor reads the moment, k times the bend. A
whisker bent beyond the limit slips off until the cycle ends.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from robot.simulation.head.beam import StreamConfig
from robot.simulation.head.kinematic import HeadSetup, MechanicsConfig
from robot.simulation.head.whisk_stream import WallSweep
from tactile.features.contact_threshold import stiffness
from tactile.whiskers.whisking import WhiskDrive, initial_drive, whisk_command

WhiskingLaw = Callable[[WhiskDrive, float, np.ndarray], tuple[np.ndarray, WhiskDrive]]
"""Whisking law: from drive states, time in the cycle (s) and newest sensor reading y [N, W] to the commanded
protractions [N, W] and the next drive states."""


class WhiskerBalance(NamedTuple):
    """State of whiskers between two samples, [N, W] each.

    Attributes:
        drive: state of the whisking law. reading: last reported y, rad. touching, slipped: bool.
        late: protraction by which a contact is delayed, rad. side: sideways bend, rad.
        before: protraction at the last sample, rad.
    """

    drive: WhiskDrive
    reading: np.ndarray
    touching: np.ndarray
    slipped: np.ndarray
    late: np.ndarray
    side: np.ndarray
    before: np.ndarray


def whiskers_at_rest(*size: int) -> WhiskerBalance:
    """Whiskers [N, W] before their first cycle, without contact."""
    zero, no = np.zeros(size), np.zeros(size, bool)
    return WhiskerBalance(initial_drive(*size), zero, no, no, zero, zero, zero)


def advance_balance(
    config: StreamConfig,
    mechanics: MechanicsConfig,
    law: WhiskingLaw,
    sweep: WallSweep,
    balance: WhiskerBalance,
) -> tuple[tuple[np.ndarray, np.ndarray, np.ndarray], WhiskerBalance]:
    """The samples of a sweep, which may be any part of a cycle, continuing from a state.

    Returns:
        angle, x and y, [T, N, W] rad, and the state after the last sample.
    """
    hard = stiffness(config.beam.shaft, sweep.reach)
    share = mechanics.servo / (mechanics.servo + hard)
    reading_noise = sweep.noise[..., 2].swapaxes(0, 1)
    slide = sweep.drift / config.rate
    angle, bent, aside = (np.zeros(sweep.wall.shape) for _ in range(3))

    drive, reading, touching, slipped, late, side, before = balance
    for k, time in enumerate(sweep.time.tolist()):
        aim, drive = law(drive, time, reading)
        # A wall that reaches a whisker from the side makes contact at the whisker's present angle.
        late = np.where(touching, late, np.maximum(before - sweep.wall[k], 0.0))
        wall = sweep.wall[k] + late
        bend = share[k] * (aim - wall)
        touching = (bend > 0) & ~slipped
        slipped = slipped | touching & (bend > mechanics.slip)
        touching &= ~slipped
        bend = np.where(touching, bend, 0.0)
        before = np.where(touching, wall + bend, aim)
        limit = config.beam.friction * bend
        side = np.minimum(np.maximum(side + slide[k], -limit), limit)
        angle[k], bent[k], aside[k] = before, bend, side
        reading = hard[k] * bend + reading_noise[k]
    after = WhiskerBalance(drive, reading, touching, slipped, late, side, before)
    return (angle, hard * aside, hard * bent), after


def simulate_quasistatic(
    setup: HeadSetup, sweep: WallSweep, threshold: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angle, x and y, [T, N, W] rad: a `robot.simulation.head.whisk_stream.MechanicsModel`."""
    head, config, mechanics, whisking = setup

    def law(drive: WhiskDrive, time: float, reading: np.ndarray) -> tuple[np.ndarray, WhiskDrive]:
        return whisk_command(whisking, drive, time, reading, threshold, head.shape)

    return advance_balance(config, mechanics, law, sweep, whiskers_at_rest(*sweep.wall.shape[1:]))[0]
