"""Settings of an emulated Create."""

from __future__ import annotations

from typing import Literal

from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from robot.drivers.create.protocol import WHEEL_BASE, WRAP
from robot.emulators.head.emulator_config import BridgeEmulatorConfig
from robot.simulation.create.strain_sensors import WhiskersConfig
from robot.simulation.create.wheel_odometry import WheelsConfig
from robot.world.arena import ArenaConfig
from tactile.base.settings import Settings


class CreateWorldConfig(Settings):
    """An arena for an emulated Create, and its whiskers there."""

    arena: ArenaConfig = ArenaConfig()
    """The arena, with the start of the robot."""
    whiskers: WhiskersConfig = WhiskersConfig()
    """The whiskers, as in the simulator."""
    wheels: WheelsConfig = WheelsConfig()
    """Errors of the odometry that the robot reports; of `measured` the scale errors, each for ten moves."""
    body: PositiveFloat = 0.17
    """Radius of the robot, m; at this distance from a wall the bumper is pressed."""
    bridge: BridgeEmulatorConfig = BridgeEmulatorConfig()
    """The USB bridge of the whiskers."""
    strain_per_radian: PositiveFloat = 0.01
    """Strain at the base of a whisker for each radian that its sensor reports."""


class FirmwareConfig(Settings):
    """What an emulated Create reports, and how; Creates of several versions misreport their motion."""

    model: Literal["create1", "create2"] = "create1"
    """The robot: speed of its port, counters or encoders."""
    distance_scale: PositiveFloat = 1.0
    """Reported distance for 1 m."""
    turn_scale: PositiveFloat = 1.0
    """Reported turn for 1 rad."""
    remainders: Literal["kept", "lost"] = "kept"
    """What becomes of the rest below 1 mm and 1 degree at a reading."""
    counts: NonNegativeInt = 0
    """Counts of both encoders at the start."""
    wrap: PositiveInt = WRAP
    """Counts after which an encoder starts again."""
    latency: NonNegativeFloat = 0.0
    """Time until a reply, s."""


class CreateEmulatorConfig(Settings):
    """Settings of an emulated Create."""

    firmware: FirmwareConfig = FirmwareConfig()
    """What it reports."""

    wheel_base: float = WHEEL_BASE
    """Distance between the wheels, m."""
    seed: int = 0
    """Random seed of arena, wheels, strain and garbage bytes."""
    port: str | None = None
    """Name of a link to the pseudo-terminal, which serves as the serial port; null: none is made."""
    world: CreateWorldConfig | None = None
    """Arena and whiskers; null: an empty plane and no whiskers."""
