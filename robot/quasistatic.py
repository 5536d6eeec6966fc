"""The quasistatic tier: whiskers and drives in balance at every sample, sensors and feedback in full.

A drive pushed back by a bent whisker gives way: of the command beyond the wall the whisker takes the share
servo / (servo + k), k being its stiffness where it is pushed over that at the reference. The sensor reads the
moment, k times the bend. A whisker bent too far slips off, and stays off until the cycle ends: it passes its
wall again without force on its way back.
"""

from __future__ import annotations

import numpy as np

from robot.kinematic import MechanicsConfig
from robot.mechanics import StreamConfig
from robot.sweep import Sweep
from tactile.contact import stiffness
from tactile.head import Head
from tactile.whisking import WhiskingConfig, command, still


def quasistatic(
    config: StreamConfig,
    mechanics: MechanicsConfig,
    whisking: WhiskingConfig,
    head: Head,
    sweep: Sweep,
    threshold: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angle, x and y, [T, N, W] rad: a `robot.sweep.Tier`."""
    size = sweep.wall.shape[1:]
    hard = stiffness(config.beam.shaft, sweep.reach)
    share = mechanics.servo / (mechanics.servo + hard)
    heard = sweep.noise[..., 2].swapaxes(0, 1)
    slide = sweep.drift / config.rate
    angle, bent, side = (np.zeros(sweep.wall.shape) for _ in range(3))

    drive, told = still(*size), np.zeros(size)
    touching, slipped = np.zeros(size, bool), np.zeros(size, bool)
    late, x, before = np.zeros(size), np.zeros(size), np.zeros(size)
    for k, time in enumerate(sweep.time):
        aim, drive = command(whisking, drive, time, told, threshold, head.shape)
        # A wall that comes upon a whisker from the side is met where the whisker is.
        late = np.where(touching, late, np.maximum(before - sweep.wall[k], 0.0))
        wall = sweep.wall[k] + late
        bend = share[k] * (aim - wall)
        touching = (bend > 0) & ~slipped
        slipped |= touching & (bend > mechanics.slip)
        touching &= ~slipped
        bend = np.where(touching, bend, 0.0)
        before = np.where(touching, wall + bend, aim)
        limit = config.beam.friction * bend
        x = np.minimum(np.maximum(x + slide[k], -limit), limit)
        angle[k], bent[k], side[k] = before, bend, x
        told = hard[k] * bend + heard[k]
    return angle, hard * side, hard * bent
