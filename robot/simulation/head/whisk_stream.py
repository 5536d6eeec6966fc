"""Walls in the sweep of whiskers at every sample, and cycles of raw samples from a mechanics model.

Here is the model of the quasistatic fidelity: whiskers and drives are in static equilibrium at every sample,
with sensors and feedback.

Of the commanded angle beyond the wall the whisker bends by the fraction servo / (servo + k), where k is its
stiffness at the contact relative to that at the reference. The sensor reads the moment, k times the bend. A
whisker bent beyond the limit slips off until the cycle ends.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from robot.simulation.head.baseline import Baseline
from robot.simulation.head.beam import StreamConfig
from robot.simulation.head.kinematic import HeadSetup, MechanicsConfig
from robot.sources.in_memory import NO_ODOMETRY
from robot.world.scene import HeadPath, poses_at
from robot.world.walls import NO_CONTACT, Surroundings
from tactile.base.se2 import between
from tactile.base.types import Cycle
from tactile.contact_threshold import stiffness
from tactile.whisker_geometry import Head
from tactile.whisking import WhiskDrive, initial_drive, whisk_command


class WallSweep(NamedTuple):
    """Walls in the sweep of parallel cycles.

    Attributes:
        time: [T] s since the start of the cycle. wall: [T, N, W] protraction at contact, rad; infinite
            without contact. reach: [T, N, W] contact position, as a fraction of the shaft.
        drift: [T, N, W] sideways angular speed of the wall as seen from the base of the whisker, rad/s.
        noise: [N, T, W, 3] noise of angle, x and y, rad.
    """

    time: np.ndarray
    wall: np.ndarray
    reach: np.ndarray
    drift: np.ndarray
    noise: np.ndarray


TrueSamples = tuple[np.ndarray, np.ndarray, np.ndarray]
"""True angle, x and y of every sample, [T, N, W] rad."""
MechanicsModel = Callable[[HeadSetup, WallSweep, np.ndarray], TrueSamples]
"""A model of the mechanics: the samples of a sweep, with contact thresholds [W] of y, rad. Its whisking law
reads y with noise."""


def simulate_cycles(
    tier: MechanicsModel,
    setup: HeadSetup,
    surroundings: Surroundings | None,
    path: HeadPath,
    start: np.ndarray,
    random: np.random.Generator,
    threshold: np.ndarray,
    baseline: Baseline | None = None,
) -> Iterator[Cycle]:
    """Raw cycles that start at times [N] s along a path, without odometry and each with whiskers at rest.

    Args:
        surroundings: the walls; None: free air. threshold: [W] contact threshold of y from a calibration,
            rad. baseline: coloured noise, drift and creep of the deflections, which go on from its state;
            None: none.
    """
    head, config, mechanics, whisking = setup
    knots = np.linspace(0.0, 1 / whisking.rate, config.poses + 1)
    time = np.arange(round(config.rate / whisking.rate)) / config.rate
    for k in range(0, len(start), config.batch):
        begins = start[k : k + config.batch]
        noise = draw_noise(mechanics, (len(begins), len(time), len(head.length)), random, baseline)
        if surroundings is None:
            sweep = sweep_air(time, noise)
        else:
            sweep = sweep_walls(surroundings, poses_at(path, begins[:, None] + knots), knots, time, noise)
        truth, heading = tier(setup, sweep, threshold), poses_at(path, begins[:, None] + time)[..., 2]
        samples = sensor_readings(config, head, truth, noise, baseline, heading)
        for begin, angle, deflection in zip(begins, *samples, strict=True):
            yield Cycle(begin + time, angle, deflection, NO_ODOMETRY)


def simulate_free_cycles(
    tier: MechanicsModel,
    setup: HeadSetup,
    count: int,
    random: np.random.Generator,
    baseline: Baseline | None = None,
) -> list[Cycle]:
    """A calibration record: `count` cycles in free air with open-loop whisking."""
    setup = setup._replace(whisking=setup.whisking.model_copy(update={"mode": "open"}))
    start, threshold = np.arange(count) / setup.whisking.rate, np.full(len(setup.head.length), np.inf)
    still = HeadPath(start, np.zeros((count, 3)))
    return list(simulate_cycles(tier, setup, None, still, start, random, threshold, baseline))


def draw_noise(
    mechanics: MechanicsConfig,
    shape: tuple[int, int, int],
    random: np.random.Generator,
    baseline: Baseline | None,
) -> np.ndarray:
    """Sensor noise of angle, x and y of the next samples, [N, T, W, 3] rad.

    Args:
        shape: successive parts N of T samples of W whiskers. baseline: colours the noise of x and y.
    """
    noise = mechanics.noise * random.standard_normal((*shape, 3))
    if baseline is not None:
        noise[..., 1:] = baseline.colour(noise[..., 1:])
    return noise


def sensor_readings(
    config: StreamConfig,
    head: Head,
    truth: TrueSamples,
    noise: np.ndarray,
    baseline: Baseline | None,
    heading: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Sensor readings for true values of a model: angles [N, T, W] and deflections [N, T, W, 2], rad.

    Args:
        noise: [N, T, W, 3] rad. baseline: its drift, creep and field are added to the deflections.
            heading: [N, T] of the head, rad.
    """
    seen = np.stack([part.swapaxes(0, 1) for part in truth], axis=-1)
    if baseline is not None:
        seen[..., 1:] += baseline.wander(seen[..., 1:], heading)
    # A dead whisker sends zeros.
    seen = (seen + noise) * head.alive[:, None]
    return seen[..., 0], np.clip(seen[..., 1:], -config.full_scale, config.full_scale)


def sweep_air(time: np.ndarray, noise: np.ndarray) -> WallSweep:
    """Sweeps [N, T, W, 3] without walls: sample times [T] s, noise rad."""
    nothing = np.zeros(noise.shape[:3]).swapaxes(0, 1)
    return WallSweep(time, nothing + NO_CONTACT, nothing + 1.0, nothing, noise)


def sweep_walls(
    surroundings: Surroundings, pose: np.ndarray, knots: np.ndarray, time: np.ndarray, noise: np.ndarray
) -> WallSweep:
    """Walls in the sweep while heads move uniformly from pose to pose.

    Args:
        pose: [N, K + 1, 3] m, m, rad; headings may be wrapped. knots: [K + 1] times of the poses, evenly
            spaced, s. time: [T] sample times, s. noise: [N, T, W, 3] rad.
    """
    head, step = surroundings.head, knots[1] - knots[0]
    met = surroundings.contact(pose.reshape(-1, 3))
    shape = (len(pose), len(knots), len(head.length))
    wall, reach, box = (column.reshape(shape).swapaxes(0, 1) for column in met)

    # Between two poses the angle of a wall changes linearly; a change of wall happens half-way.
    place = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, len(knots) - 2)
    share = ((time - knots[place]) / step)[:, None, None]
    same = (box[:-1] == box[1:]) & (box[1:] >= 0)
    share = np.where(same[place], share, np.round(share))
    # Sideways angular speed [K, N, W] of the walls.
    motion = between(pose[:, :-1].reshape(-1, 3), pose[:, 1:].reshape(-1, 3)).reshape(*pose[:, 1:].shape)
    speed, outwards = motion.swapaxes(0, 1)[:, :, None] / step, surroundings.outwards
    opening = surroundings.opening - np.where(wall < NO_CONTACT, wall, 0.0)
    arm = np.maximum(reach, 0.05) * head.length
    out = surroundings.radius + arm * np.sin(opening)
    sideways = speed[..., 1] * outwards[:, 0] - speed[..., 0] * outwards[:, 1] + speed[..., 2] * out[:-1]
    drift = -sideways / arm[:-1]
    with np.errstate(invalid="ignore"):
        mixed = wall[place] + share * (wall[place + 1] - wall[place])
    return WallSweep(
        time=time,
        wall=np.where(share == 0, wall[place], np.where(share == 1, wall[place + 1], mixed)),
        reach=np.maximum(reach[place] + share * (reach[place + 1] - reach[place]), 0.05),
        drift=drift[place],
        noise=noise,
    )


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
) -> tuple[TrueSamples, WhiskerBalance]:
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


def simulate_quasistatic(setup: HeadSetup, sweep: WallSweep, threshold: np.ndarray) -> TrueSamples:
    """Angle, x and y, [T, N, W] rad: a `robot.simulation.head.whisk_stream.MechanicsModel`."""
    head, config, mechanics, whisking = setup

    def law(drive: WhiskDrive, time: float, reading: np.ndarray) -> tuple[np.ndarray, WhiskDrive]:
        return whisk_command(whisking, drive, time, reading, threshold, head.shape)

    return advance_balance(config, mechanics, law, sweep, whiskers_at_rest(*sweep.wall.shape[1:]))[0]
