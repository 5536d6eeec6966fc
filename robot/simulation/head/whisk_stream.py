"""Walls in the sweep of whiskers at every sample, and cycles of raw samples from a mechanics model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np

from robot.simulation.head.baseline import Baseline
from robot.simulation.head.beam import StreamConfig
from robot.simulation.head.kinematic import HeadSetup, MechanicsConfig
from robot.sources.simulated import NO_ODOMETRY
from robot.world.head_trajectory import HeadPath, poses_at
from robot.world.walls import NO_CONTACT, Surroundings
from tactile.base.se2 import between
from tactile.base.types import Cycle
from tactile.whiskers.head_geometry import Head


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


class MechanicsModel(Protocol):
    """A model of the mechanics."""

    def __call__(
        self, setup: HeadSetup, sweep: WallSweep, threshold: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """True angle, x and y of every sample, [T, N, W] rad; the whisking law reads y with noise."""
        ...


def simulate_cycles(
    tier: MechanicsModel,
    setup: HeadSetup,
    surroundings: Surroundings,
    path: HeadPath,
    start: np.ndarray,
    random: np.random.Generator,
    threshold: np.ndarray,
    baseline: Baseline | None = None,
) -> Iterator[Cycle]:
    """Raw cycles that start at times [N] s along a path, without odometry and each with whiskers at rest.

    Args:
        threshold: [W] contact threshold of y from a calibration, rad. baseline: coloured noise, drift and
            creep of the deflections, which go on from its state; None: none.
    """
    config, whisking = setup.config, setup.whisking
    knots = np.linspace(0.0, 1 / whisking.rate, config.poses + 1)
    time = _times(setup)
    for k in range(0, len(start), config.batch):
        some = start[k : k + config.batch]
        pose = poses_at(path, some[:, None] + knots)
        noise = draw_noise(setup.mechanics, _shape(setup, len(some)), random, baseline)
        sweep = sweep_walls(surroundings, pose, knots, time, noise)
        yield from _run(tier, setup, sweep, threshold, some, baseline)


def simulate_free_cycles(
    tier: MechanicsModel,
    setup: HeadSetup,
    count: int,
    random: np.random.Generator,
    baseline: Baseline | None = None,
) -> list[Cycle]:
    """A calibration record: `count` cycles in free air with open-loop whisking.

    Args:
        baseline: as in `simulate_cycles`.
    """
    setup = setup._replace(whisking=setup.whisking.model_copy(update={"mode": "open"}))
    start, time = np.arange(count) / setup.whisking.rate, _times(setup)
    threshold = np.full(len(setup.head.length), np.inf)
    record: list[Cycle] = []
    for k in range(0, count, setup.config.batch):
        some = start[k : k + setup.config.batch]
        nothing = np.zeros((len(time), len(some), len(setup.head.length)))
        noise = draw_noise(setup.mechanics, _shape(setup, len(some)), random, baseline)
        sweep = WallSweep(time, nothing + NO_CONTACT, nothing + 1.0, nothing, noise)
        record += _run(tier, setup, sweep, threshold, some, baseline)
    return record


def _run(
    tier: MechanicsModel,
    setup: HeadSetup,
    sweep: WallSweep,
    threshold: np.ndarray,
    start: np.ndarray,
    baseline: Baseline | None,
) -> Iterator[Cycle]:
    truth = tier(setup, sweep, threshold)
    angle, deflection = sensor_readings(setup.config, setup.head, truth, sweep.noise, baseline)
    for k in range(len(start)):
        yield Cycle(start[k] + sweep.time, angle[k], deflection[k], NO_ODOMETRY)


def _times(setup: HeadSetup) -> np.ndarray:
    """Sample times [T] of a cycle, s."""
    return np.arange(round(setup.config.rate / setup.whisking.rate)) / setup.config.rate


def _shape(setup: HeadSetup, cycles: int) -> tuple[int, int, int]:
    """Numbers of cycles, of samples of a cycle and of whiskers."""
    return cycles, len(_times(setup)), len(setup.head.length)


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
    truth: tuple[np.ndarray, np.ndarray, np.ndarray],
    noise: np.ndarray,
    baseline: Baseline | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Sensor readings for true values of a model: angles [N, T, W] and deflections [N, T, W, 2], rad.

    Args:
        noise: [N, T, W, 3] rad. baseline: its drift and creep are added to the deflections.
    """
    seen = np.stack([part.swapaxes(0, 1) for part in truth], axis=-1)
    if baseline is not None:
        seen[..., 1:] += baseline.wander(seen[..., 1:])
    # A dead whisker sends zeros.
    seen = (seen + noise) * head.alive[:, None]
    return seen[..., 0], np.clip(seen[..., 1:], -config.full_scale, config.full_scale)


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
    drift = _drift(head, pose, step, wall, reach)
    with np.errstate(invalid="ignore"):
        mixed = wall[place] + share * (wall[place + 1] - wall[place])
    return WallSweep(
        time=time,
        wall=np.where(share == 0, wall[place], np.where(share == 1, wall[place + 1], mixed)),
        reach=np.maximum(reach[place] + share * (reach[place + 1] - reach[place]), 0.05),
        drift=drift[place],
        noise=noise,
    )


def _drift(head: Head, pose: np.ndarray, step: float, wall: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Sideways angular speed [K, N, W] of walls between successive poses, rad/s."""
    motion = between(pose[:, :-1].reshape(-1, 3), pose[:, 1:].reshape(-1, 3)).reshape(*pose[:, 1:].shape)
    speed = motion.swapaxes(0, 1)[:, :, None] / step
    outwards = head.rest[:, :2] / np.linalg.norm(head.rest[:, :2], axis=1, keepdims=True)
    opening = np.arctan2(np.hypot(*head.rest[:, :2].T), -head.rest[:, 2])
    opening = opening - np.where(wall < NO_CONTACT, wall, 0.0)
    arm = np.maximum(reach, 0.05) * head.length
    out = np.hypot(*head.base[:, :2].T) + arm * np.sin(opening)
    sideways = speed[..., 1] * outwards[:, 0] - speed[..., 0] * outwards[:, 1] + speed[..., 2] * out[:-1]
    return -sideways / arm[:-1]
