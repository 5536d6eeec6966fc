"""Settings of an emulated Create."""

from __future__ import annotations

from pydantic import PositiveFloat

from robot.drivers.create.protocol import WHEEL_BASE
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


class CreateEmulatorConfig(Settings):
    """Settings of an emulated Create."""

    wheel_base: float = WHEEL_BASE
    """Distance between the wheels, m."""
    seed: int = 0
    """Random seed of arena, wheels, strain and garbage bytes."""
    port: str | None = None
    """Name of a link to the pseudo-terminal, which serves as the serial port; null: none is made."""
    world: CreateWorldConfig | None = None
    """Arena and whiskers; null: an empty plane and no whiskers."""
