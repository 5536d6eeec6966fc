"""Strain of the fixed whiskers of an emulated Create, at the rate of their bridge."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from robot.drivers.head.protocol import Command
from robot.emulators.create.config import CreateWorldConfig
from robot.emulators.create.robot import EmulatedCreate
from robot.emulators.head.sensor_array import Block, block_samples
from robot.simulation.create.strain_sensors import BodyVibration, base_strains, bend_whiskers, fixed_whiskers
from robot.world.polygons import segment_distance


class CreateWhiskers:
    """The whiskers of a Create as a `SensorArray`: angles are 0, deflections the two strains.

    Args:
        move: advances the robot to a time, s, host's monotonic clock.
    """

    def __init__(
        self,
        config: CreateWorldConfig,
        robot: EmulatedCreate,
        move: Callable[[float], None],
        random: np.random.Generator,
    ) -> None:
        self.config, self._robot, self._move, self._random = config, robot, move, random
        self._fan = fixed_whiskers(config.whiskers)
        self._samples = block_samples(config.whiskers.rate)
        self._shaking = BodyVibration(config.whiskers.shake, config.whiskers.rate, random)
        self._side = np.zeros(self.count, int)
        self._pose = robot.pose
        self._changes = 0

    @property
    def count(self) -> int:
        return len(self._fan.base)

    @property
    def resting(self) -> bool:
        return True

    def begin(self, time: float) -> None:
        """The robot moves by its own commands."""

    def block(self, start: float, end: float) -> Block:
        self._move(end)
        before, self._pose = self._pose, self._robot.pose
        share = (np.arange(self._samples) + 1)[:, None] / self._samples
        poses = before + share * (self._pose - before)
        walls = self._robot.walls
        near = walls[segment_distance(walls, before[:2]) < self._fan.reach + 0.05]
        bent = bend_whiskers(self._fan, poses, near, self._side)
        self._side = bent.side[-1]
        changed, self._changes = self._changes != len(self._robot.speeds), len(self._robot.speeds)
        rolls = bool(self._robot.right or self._robot.left)
        shake = self._shaking.advance(self._samples, rolls=rolls, starts=changed and rolls)
        strain = base_strains(self.config.whiskers, self._fan, bent) + shake[:, None]
        strain += self.config.whiskers.noise * self._random.standard_normal(strain.shape)
        strain = np.where(self._fan.alive[:, None], strain, 0.0)
        still = np.zeros(self._samples, bool)
        return Block(
            np.zeros(strain.shape[:2]), strain / self.config.strain_per_radian, still, fed_back=False
        )

    def skip_block(self) -> None:
        self._pose = self._robot.pose

    def receive(self, command: Command, now: float) -> None:
        """Fixed whiskers have no drives."""

    def stop(self) -> None:
        """Fixed whiskers have no drives."""

    def state(self, now: float) -> dict[str, Any]:
        return {"pose": self._robot.pose.tolist(), "side": self._side.tolist()}
