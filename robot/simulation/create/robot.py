"""The Create among walls: one motion after the other, each as told until whiskers or body object."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robot.simulation.create.state_machine import (
    BehaviourConfig,
    CreateState,
    WheelCommand,
    drive,
    motion_end,
)
from robot.simulation.create.strain_sensors import (
    WhiskersConfig,
    base_strains,
    bend_whiskers,
    fixed_whiskers,
    monitor_strain,
    sample_strain,
)
from robot.world.polygons import segment_distance
from tactile.base.types import StepEnd

MIN_DURATION = 1e-6
"""Shortest motion, s."""


class CreateStep(NamedTuple):
    """One motion of the robot.

    Attributes:
        state: what it was doing. moment: how that ended. duration: s. pose: [3] at its end, heading not
            wrapped. side: [W] to which side whiskers were bent then. contact: [W] bool, which touched then.
        strain: [T, W, 2] during FWD2, else of no samples.
    """

    state: CreateState
    moment: StepEnd
    duration: float
    pose: np.ndarray
    side: np.ndarray
    contact: np.ndarray
    strain: np.ndarray


class CreateRobot:
    """The Create among walls [S, 4]: makes one motion after the other."""

    def __init__(
        self,
        behaviour: BehaviourConfig,
        whiskers: WhiskersConfig,
        walls: np.ndarray,
        random: np.random.Generator,
    ) -> None:
        self.behaviour, self.whiskers, self.walls = behaviour, whiskers, walls
        self.fan = fixed_whiskers(whiskers)
        self._random = random

    def at(self, pose: np.ndarray) -> CreateStep:
        """Standing at a pose, about to drive on."""
        free = np.zeros(len(self.fan.base), int)
        none = np.zeros((0, len(free), 2))
        return CreateStep(CreateState.FWD1, StepEnd.FREE, 0.0, pose, free, free.astype(bool), none)

    def step(self, last: CreateStep, state: CreateState, told: WheelCommand) -> CreateStep:
        """The motion that is told, until it ends by itself or early."""
        config = self.behaviour
        count = max(int(np.ceil(told.duration / config.period - 1e-9)), 1)
        time = np.minimum(np.arange(1, count + 1) * config.period, max(told.duration, MIN_DURATION))
        near = self._near(last.pose, told)
        poses = drive(told, last.pose, time)
        bent = bend_whiskers(self.fan, poses, near, last.side)
        strain = base_strains(self.whiskers, self.fan, bent)
        known = monitor_strain(self.whiskers, strain, self.fan.alive, config.period, self._random)
        end = motion_end(config, state, known, self._bumps(last.pose, poses, near), last.contact)
        duration = float(time[end.row])
        return CreateStep(
            state,
            end.moment,
            duration,
            poses[end.row],
            bent.side[end.row],
            np.abs(known[end.row, :, 0]) > config.contact,
            self._felt(last, near, told, duration if state == CreateState.FWD2 else 0.0),
        )

    def _near(self, pose: np.ndarray, told: WheelCommand) -> np.ndarray:
        """The walls that can be touched or bumped into."""
        room = max(self.fan.reach, self.behaviour.body) + abs(told.speed) * told.duration
        return self.walls[segment_distance(self.walls, pose[:2]) < room]

    def _bumps(self, start: np.ndarray, poses: np.ndarray, near: np.ndarray) -> np.ndarray:
        """[T] bool, the body is as near to a wall as it can get, and getting nearer."""
        if not len(near):
            return np.zeros(len(poses), bool)
        room = segment_distance(near, np.vstack([start, poses])[:, :2]).min(axis=1)
        return (room[1:] < self.behaviour.body) & (np.diff(room) < 0)

    def _felt(self, last: CreateStep, near: np.ndarray, told: WheelCommand, duration: float) -> np.ndarray:
        time = np.arange(round(duration * self.whiskers.rate)) / self.whiskers.rate
        if not len(time):
            return np.zeros((0, len(self.fan.base), 2))
        bent = bend_whiskers(self.fan, drive(told, last.pose, time), near, last.side)
        strain = base_strains(self.whiskers, self.fan, bent)
        return sample_strain(self.whiskers, strain, self.fan.alive, self._random)
