"""A simulated session of the whiskered Create as a source, bit-identical for the same settings.

Every step of the state machine is one `Report`. Every part draws from its own random stream (arena,
behaviour, wheels, strain), so that changing one part leaves the others unchanged.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, NonNegativeInt

from robot.simulation.create.state_machine import (
    BehaviourConfig,
    CreateState,
    MachineState,
    WheelCommand,
    drive,
    motion_end,
    next_state,
    planned_rows,
    wheel_command,
)
from robot.simulation.create.strain_sensors import (
    WhiskersConfig,
    base_strains,
    bend_whiskers,
    fixed_whiskers,
    monitor_strain,
    sample_strain,
)
from robot.simulation.create.wheel_odometry import WheelsConfig, simulate_wheel_odometry
from robot.sources.in_memory import NO_ODOMETRY, SimulatedSource, digest_of_document, wrap_headings
from robot.sources.source import PlanarWhiskersInfo, SourceInfo, rate_of
from robot.world.arena import Arena, ArenaConfig, arena_text, make_arena, wall_segments
from robot.world.walls import segment_distance
from tactile.base.errors import InputError
from tactile.base.random_streams import stream
from tactile.base.se2 import between
from tactile.base.settings import Settings
from tactile.base.types import Odometry, Report, StepEnd
from tactile.wall_estimation.strain_templates import (
    StrainTemplates,
    TemplateTraining,
    train_templates,
)


class CreateSimulationConfig(Settings):
    """A simulated session of the Create. The defaults fill in what Fox et al. 2012 leave open."""

    arena: ArenaConfig = ArenaConfig()
    """Arena."""
    behaviour: BehaviourConfig = BehaviourConfig()
    """State machine."""
    whiskers: WhiskersConfig = WhiskersConfig()
    """Whiskers and strain sensors."""
    wheels: WheelsConfig = WheelsConfig()
    """Odometry errors."""
    minutes: Annotated[float, Field(gt=0, le=1000)] = 6.0
    """Duration, min."""
    reports: Annotated[int, Field(ge=1, le=100_000)] | None = None
    """Number of steps, instead of a duration."""
    seed: NonNegativeInt = 0
    """Seed of all random streams."""


class CreateSimulation(SimulatedSource):
    """A simulated session of the Create as a `Source`.

    Attributes:
        config: its settings. arena: its arena. steps: [N] motions of the robot.
        time: [N] s, end of each step. truth: [N, 3] at these times. odometry: [N, 4].

    Raises:
        InputError: the configuration cannot be simulated; the error gives key and reason.
    """

    name = "create_simulation"
    view_shape = (1, 4, 1)

    def __init__(self, config: CreateSimulationConfig) -> None:
        self.config = config
        self.arena = make_arena(config.arena, config.seed)
        walls, noise = wall_segments(self.arena), stream(config.seed, "strain")
        robot = _CreateRobot(config, walls, noise)
        self.whiskers = len(robot.whiskers.base)
        start, random = robot.at(self.arena.start), stream(config.seed, "behaviour")
        self.steps: list[_CreateStep] = []
        step, doing, time = start, MachineState(CreateState.FWD1), 0.0
        while (len(self.steps) < config.reports) if config.reports else (time < 60 * config.minutes):
            before, command = step, wheel_command(config.behaviour, doing)
            step = robot.step(before, doing.state, command)
            self.steps.append(step)
            time += step.duration
            turned = float(step.pose[2] - before.pose[2])
            doing = next_state(config.behaviour, doing, step.moment, turned, random)
        steps = self.steps
        duration = np.array([step.duration for step in steps])
        self.time = np.cumsum(duration)
        self.rate_hz = rate_of(self.time)
        pose = np.array([start.pose, *(step.pose for step in steps)])
        self.truth = wrap_headings(pose[1:])
        motion = np.column_stack([between(pose[:-1], pose[1:])[:, :2], np.diff(pose[:, 2]), duration])
        kind = np.array([step.state.motion for step in steps])
        self.odometry = simulate_wheel_odometry(config.wheels, motion, kind, stream(config.seed, "wheels"))
        self.info = describe_create(config, self.arena)
        document = {"create_simulation": self.info.provenance["create_simulation"], "arena": self.info.arena}
        self.digest = digest_of_document(document)

    def _readings(self) -> Iterator[Report]:
        return (make_report(self.config, step, NO_ODOMETRY) for step in self.steps)


def describe_create(config: CreateSimulationConfig, arena: Arena) -> SourceInfo:
    """Whiskers, arena and settings of a session; strain templates are trained from these."""
    mounts = tuple((mount.x, mount.y, mount.direction_deg) for mount in config.whiskers.mounts)
    return SourceInfo(
        raw_whiskers=True,
        planar_whiskers=PlanarWhiskersInfo(mounts=mounts, length=config.whiskers.length),
        arena=arena_text(arena),
        provenance={"create_simulation": config.model_dump(mode="json", exclude={"arena": {"file"}})},
    )


HALF_WALL = 10.0
"""Half the length of a wall that the robot cannot drive around, m."""
APPROACH = 0.015
"""Largest distance of the wall at the start, m."""
RECORD_TIME = 2.0
"""Duration of the recorded strain, s (Fox et al. 2012, II-G)."""


def drive_into_wall(config: CreateSimulationConfig, angle: float, random: np.random.Generator) -> Report:
    """The report of a drive into one flat wall, for strain templates.

    The robot drives to the first contact as in FWD1, then for `RECORD_TIME` as in FWD2, regardless of strain.
    The report is of this second motion; its first sample is taken at contact.

    Args:
        angle: direction of the wall in base_link, rad, counter-clockwise from ahead: pi / 2 is perpendicular
            to the motion, with a smaller angle the wall is on the right, with a larger one on the left.

    Raises:
        InputError: the whiskers report no contact.
    """
    towards = np.array([np.sin(angle), -np.cos(angle)])
    if towards[0] < 0.05:
        raise ValueError(f"the robot does not drive into a wall at {angle:g} rad")
    whiskers, behaviour = config.whiskers, config.behaviour
    room = float((fixed_whiskers(whiskers).tip @ towards).max())
    room += APPROACH * random.uniform(0.5, 1.0) * towards[0]
    along = HALF_WALL * np.array([np.cos(angle), np.sin(angle)])
    wall = np.concatenate([room * towards - along, room * towards + along])[None]
    robot = _CreateRobot(config, wall, random)
    step = robot.at(np.zeros(3))
    while step.moment == StepEnd.FREE and step.pose[0] < 2 * APPROACH + whiskers.length:
        step = robot.step(step, CreateState.FWD1, WheelCommand(behaviour.fast, 0.0, behaviour.step))
    if step.moment != StepEnd.HIT1:
        wall_text = f"a wall at {np.degrees(angle):.0f} degrees"
        found = f"no contact at a strain of {behaviour.contact:g} with {wall_text}"
        expected = "a lower strain, or whiskers that reach beyond the body"
        raise InputError("create_simulation.behaviour.contact", found, expected)
    robot.behaviour = behaviour.model_copy(update={"safety": np.inf, "least": RECORD_TIME})
    push = robot.step(step, CreateState.FWD2, WheelCommand(behaviour.slow, 0.0, RECORD_TIME))
    return make_report(config, push, Odometry(behaviour.slow * RECORD_TIME, 0.0, 0.0, RECORD_TIME))


def make_report(config: CreateSimulationConfig, step: _CreateStep, odometry: Odometry) -> Report:
    """A step as a reading."""
    return Report(
        odometry=odometry,
        motion=int(step.state.motion),
        moment=int(step.moment),
        alive=fixed_whiskers(config.whiskers).alive,
        contact=step.contact.copy(),
        time=np.arange(len(step.strain)) / config.whiskers.rate,
        strain=step.strain.copy(),
    )


def train_strain_templates(config: CreateSimulationConfig) -> StrainTemplates:
    """Strain templates of the robot of a session, from its seed (Fox et al. 2012, II-G)."""
    training = TemplateTraining(rate=config.whiskers.rate, speed=config.behaviour.slow)
    random = stream(config.seed, "templates")
    each = product(training.angles.tolist(), range(training.repeats))
    return train_templates(training, [drive_into_wall(config, at, random).strain for at, _ in each])


MIN_DURATION = 1e-6
"""Shortest duration of a motion, s."""


class _CreateStep(NamedTuple):
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


class _CreateRobot:
    """The Create among walls [S, 4] (x1, y1, x2, y2, m)."""

    def __init__(
        self, config: CreateSimulationConfig, walls: np.ndarray, random: np.random.Generator
    ) -> None:
        self.behaviour, self.sensors, self.walls = config.behaviour, config.whiskers, walls
        self.whiskers, self._random = fixed_whiskers(config.whiskers), random

    def at(self, pose: np.ndarray) -> _CreateStep:
        """The state before the first motion from a pose."""
        free = np.zeros(len(self.whiskers.base), int)
        none = np.zeros((0, len(free), 2))
        return _CreateStep(CreateState.FWD1, StepEnd.FREE, 0.0, pose, free, free.astype(bool), none)

    def step(self, last: _CreateStep, state: CreateState, command: WheelCommand) -> _CreateStep:
        """Execute a motion until its planned or early end."""
        config = self.behaviour
        count = planned_rows(config, command)
        time = np.minimum(np.arange(1, count + 1) * config.period, max(command.duration, MIN_DURATION))
        # Walls within reach of whiskers or body during the motion.
        room = max(self.whiskers.reach, config.body) + abs(command.speed) * command.duration
        near = self.walls[segment_distance(self.walls, last.pose[:2]) < room]
        poses = drive(command, last.pose, time)
        bent = bend_whiskers(self.whiskers, poses, near, last.side)
        strain = base_strains(self.sensors, self.whiskers, bent)
        known = monitor_strain(self.sensors, strain, self.whiskers.alive, config.period, self._random)
        bumped = np.zeros(len(poses), bool)  # the body touches a wall and approaches it
        if len(near):
            gap = segment_distance(near, np.vstack([last.pose, poses])[:, :2]).min(axis=1)
            bumped = (gap[1:] < config.body) & (np.diff(gap) < 0)
        end = motion_end(config, state, known, bumped, last.contact, count - 1)
        assert end is not None
        row, moment = end
        duration = float(time[row])
        contact = np.abs(known[row, :, 0]) > config.contact
        samples = round(duration * self.sensors.rate) if state == CreateState.FWD2 else 0
        sampled = np.zeros((0, len(contact), 2))
        if samples:
            poses_sampled = drive(command, last.pose, np.arange(samples) / self.sensors.rate)
            bent_then = bend_whiskers(self.whiskers, poses_sampled, near, last.side)
            strain = base_strains(self.sensors, self.whiskers, bent_then)
            sampled = sample_strain(self.sensors, strain, self.whiskers.alive, self._random)
        return _CreateStep(state, moment, duration, poses[row], bent.side[row], contact, sampled)
