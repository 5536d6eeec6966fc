"""The dynamic fidelity: drives with inertia, whiskers with two bending modes, elastic walls.

Each whisker is a linear system of six states, its angle and the two loads of `Beam` with their rates, driven
by the command (linear between samples) and the force of the wall (constant between samples), and is
integrated exactly by a matrix exponential. The wall is a stiff spring whose force is taken at the end of the
sample (implicit, stable at any stiffness):
    force = spring x (depth without force) / (1 + spring x give).
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import expm

from robot.simulation.head.beam import Beam, beam_time_unit, make_beam
from robot.simulation.head.kinematic import HeadSetup
from robot.simulation.head.whisk_stream import WallSweep
from tactile.features.contact import stiffness
from tactile.whiskers.whisking import initial_drive, whisk_command

WALL_STIFFNESS = 300.0
"""Ratio of wall stiffness to whisker stiffness."""


def simulate_dynamic(
    setup: HeadSetup, sweep: WallSweep, threshold: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angle, x and y, [T, N, W] rad: a `robot.simulation.head.whisk_stream.MechanicsModel`."""
    head, config, mechanics, whisking = setup
    model = make_beam(config.beam.shaft)
    step, push = _systems(setup, model)  # [W, 6, 8], [W, 6, 3]
    # Displacement of the contact point per unit of each of the first three states.
    arm = np.concatenate([sweep.reach[None], model.at(sweep.reach)])  # [3, T, N, W]
    give = np.einsum("itnw,wij,jtnw->tnw", arm, push[:, :3], arm, optimize=True)
    spring = WALL_STIFFNESS * model.unit
    force_per = 1 / (1 / spring + give)
    reading_noise = sweep.noise[..., 2].swapaxes(0, 1)
    slide, hard = sweep.drift / config.rate, stiffness(config.beam.shaft, sweep.reach)
    angle, side, moment = (np.zeros(sweep.wall.shape) for _ in range(3))

    size = sweep.wall.shape[1:]
    state = np.zeros((size[1], 8, size[0]))  # for each whisker: six states, command, rate of the command
    drive, reading, aim = initial_drive(*size), np.zeros(size), np.zeros(size)
    touching, slipped = np.zeros(size, bool), np.zeros(size, bool)
    late, x, before = np.zeros(size), np.zeros(size), np.zeros(size)
    for k, time in enumerate(sweep.time):
        last, (aim, drive) = aim, whisk_command(whisking, drive, time, reading, threshold, head.shape)
        state[:, 6], state[:, 7] = last.T, (aim - last).T
        state[:, :6] = step @ state
        # A wall that reaches a whisker from the side makes contact at the whisker's present angle.
        late = np.where(touching, late, np.maximum(before - sweep.wall[k], 0.0))
        wall = sweep.wall[k] + late
        place = arm[:, k]
        along = state[:, :3].T  # [N, 3, W], axes from the end
        depth = place[0] * (along[:, 0] - wall) + place[1] * along[:, 1] + place[2] * along[:, 2]
        touching = (depth > 0) & ~slipped
        force = np.where(touching, depth * force_per[k], 0.0)
        state[:, :6] -= push @ (place * force).transpose(2, 0, 1)
        slipped |= touching & (along[:, 0] - wall > mechanics.slip)
        before = along[:, 0] + (place[1] * along[:, 1] + place[2] * along[:, 2]) / place[0]
        y = -(model.moment[0] * along[:, 1] + model.moment[1] * along[:, 2]) / model.unit
        limit = config.beam.friction * force * place[0] / (hard[k] * model.unit)
        x = np.minimum(np.maximum(x + slide[k], -limit), limit)
        angle[k], side[k], moment[k] = along[:, 0], hard[k] * x, y
        reading = y + reading_noise[k]
    return angle, side, moment


def _systems(setup: HeadSetup, model: Beam) -> tuple[np.ndarray, np.ndarray]:
    """State transition [W, 6, 8] of one sample, and effect [W, 6, 3] of forces along the first three states.

    Units are the length, rigidity and mass of each whisker; rates are per time unit of its beam, the rate of
    the command is per sample.
    """
    head, config, mechanics, _ = setup
    servo = mechanics.servo * model.unit
    lengths, which = np.unique(head.length, return_inverse=True)
    steps, pushes = [], []
    for length in lengths:
        unit = beam_time_unit(config.beam, float(length))
        sample = 1 / (config.rate * unit)
        rotor = servo / (2 * np.pi * config.servo.frequency * unit) ** 2
        mass = np.zeros((3, 3))
        mass[0, 0] = rotor + model.inertia
        mass[0, 1:] = mass[1:, 0] = model.coupled
        mass[1:, 1:] = model.mass
        drag = 2 * config.servo.damping * np.sqrt(servo * mass[0, 0])
        spring, damper = np.zeros((3, 3)), np.zeros((3, 3))
        spring[0, 0], damper[0, 0] = servo, drag
        spring[1:, 1:] = model.stiffness
        damper[1:, 1:] = 2 * config.beam.damping / model.modes[0] * model.stiffness
        inverse = np.linalg.inv(mass)
        flow = np.zeros((11, 11))  # six states, command, its rate, three forces
        flow[:3, 3:6] = sample * np.eye(3)
        flow[3:6, :3], flow[3:6, 3:6] = -sample * inverse @ spring, -sample * inverse @ damper
        flow[3:6, 6], flow[3:6, 7] = sample * inverse[:, 0] * servo, inverse[:, 0] * drag
        flow[6, 7] = 1.0
        flow[3:6, 8:] = sample * inverse
        carried = expm(flow)
        steps.append(carried[:6, :8])
        pushes.append(carried[:6, 8:])
    return np.array(steps)[which], np.array(pushes)[which]
