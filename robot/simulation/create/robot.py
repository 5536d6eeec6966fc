"""The Create among walls: executes motions until their planned end or a contact of whiskers or body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from robot.simulation.create.state_machine import (
    BehaviourConfig,
    CreateState,
    WheelCommand,
    drive,
    motion_end,
    planned_rows,
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
"""Shortest duration of a motion, s."""


class CreateStep(NamedTuple):
    """One motion of the robot.

    Attributes:
        state: of the state machine. moment: kind of end. duration: s. pose: [3] at its end (m, m, rad),
            heading not wrapped. side: [W] bending side at its end. contact: [W] bool at its end.
        strain: [T, W, 2] during FWD2, otherwise without samples.
    """

    state: CreateState
    moment: StepEnd
    duration: float
    pose: np.ndarray
    side: np.ndarray
    contact: np.ndarray
    strain: np.ndarray


class CreateRobot:
    """The Create among walls [S, 4] (x1, y1, x2, y2, m).

    Attributes:
        whiskers: its whiskers.
    """

    def __init__(
        self,
        behaviour: BehaviourConfig,
        whiskers: WhiskersConfig,
        walls: np.ndarray,
        random: np.random.Generator,
    ) -> None:
        self.behaviour, self.sensors, self.walls = behaviour, whiskers, walls
        self.whiskers = fixed_whiskers(whiskers)
        self._random = random

    def at(self, pose: np.ndarray) -> CreateStep:
        """The state before the first motion from a pose."""
        free = np.zeros(len(self.whiskers.base), int)
        none = np.zeros((0, len(free), 2))
        return CreateStep(CreateState.FWD1, StepEnd.FREE, 0.0, pose, free, free.astype(bool), none)

    def step(self, last: CreateStep, state: CreateState, command: WheelCommand) -> CreateStep:
        """Execute a motion until its planned or early end."""
        config = self.behaviour
        count = planned_rows(config, command)
        time = np.minimum(np.arange(1, count + 1) * config.period, max(command.duration, MIN_DURATION))
        near = self._near(last.pose, command)
        poses = drive(command, last.pose, time)
        bent = bend_whiskers(self.whiskers, poses, near, last.side)
        strain = base_strains(self.sensors, self.whiskers, bent)
        known = monitor_strain(self.sensors, strain, self.whiskers.alive, config.period, self._random)
        end = motion_end(config, state, known, self._bumps(last.pose, poses, near), last.contact)
        duration = float(time[end.row])
        return CreateStep(
            state,
            end.moment,
            duration,
            poses[end.row],
            bent.side[end.row],
            np.abs(known[end.row, :, 0]) > config.contact,
            self._sampled_strain(last, near, command, duration if state == CreateState.FWD2 else 0.0),
        )

    def _near(self, pose: np.ndarray, command: WheelCommand) -> np.ndarray:
        """Walls within reach of whiskers or body during a motion."""
        room = max(self.whiskers.reach, self.behaviour.body) + abs(command.speed) * command.duration
        return self.walls[segment_distance(self.walls, pose[:2]) < room]

    def _bumps(self, start: np.ndarray, poses: np.ndarray, near: np.ndarray) -> np.ndarray:
        """[T] bool, whether the body touches a wall and approaches it."""
        if not len(near):
            return np.zeros(len(poses), bool)
        room = segment_distance(near, np.vstack([start, poses])[:, :2]).min(axis=1)
        return (room[1:] < self.behaviour.body) & (np.diff(room) < 0)

    def _sampled_strain(
        self, last: CreateStep, near: np.ndarray, command: WheelCommand, duration: float
    ) -> np.ndarray:
        time = np.arange(round(duration * self.sensors.rate)) / self.sensors.rate
        if not len(time):
            return np.zeros((0, len(self.whiskers.base), 2))
        bent = bend_whiskers(self.whiskers, drive(command, last.pose, time), near, last.side)
        strain = base_strains(self.sensors, self.whiskers, bent)
        return sample_strain(self.sensors, strain, self.whiskers.alive, self._random)
