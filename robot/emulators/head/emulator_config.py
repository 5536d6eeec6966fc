"""Settings of an emulated head."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, NonNegativeInt, PositiveInt, model_validator

from robot.drivers.head.driver_config import PORT
from robot.drivers.ur10.driver_config import BaseTransformConfig
from robot.simulation.head.beam import StreamConfig
from robot.simulation.head.kinematic import MechanicsConfig
from robot.world.scene import MazeConfig, MotionConfig, PathConfig
from tactile.base.settings import Settings
from tactile.whisker_geometry import HeadConfig

CONTROL_PORT = 30099
"""Port for fault requests."""


class BridgeEmulatorConfig(Settings):
    """The emulated USB bridge of any whiskers."""

    host: str = "127.0.0.1"
    """Address to listen on."""
    open_to_network: bool = False
    """Whether the address may be one that others reach, who may then command, fault or stop it."""
    port: Annotated[int, Field(ge=0, le=65535)] = PORT
    """Port of the emulated USB."""
    control_port: Annotated[int, Field(ge=0, le=65535)] = CONTROL_PORT
    """Port for fault requests."""
    stream: StreamConfig = StreamConfig()
    """Sample rate, saturation, shafts."""
    seed: NonNegativeInt = 0
    """Random seed of maze, path and sensor noise, with the streams of the simulator."""
    drift_ppm: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    """Drift of the head's clock, ppm; positive is fast."""
    age: Annotated[float, Field(ge=0)] = 0.0
    """Time since power-on at the start, s of the head's clock. Times wrap at 4294.967 s, sample numbers
    at 2147483.6 s (2 kHz)."""
    fifo: PositiveInt = 4096
    """Capacity of the frame queue."""


class HeadEmulatorConfig(BridgeEmulatorConfig):
    """An emulated head in a simulated maze."""

    head: HeadConfig = HeadConfig()
    """The whiskers."""
    mechanics: MechanicsConfig = MechanicsConfig()
    """Drives, whiskers and sensors."""
    maze: MazeConfig = MazeConfig()
    """The maze."""
    path: PathConfig = PathConfig()
    """The path, which also determines the maze; the head moves along it if `follow` is set."""
    motion: MotionConfig = MotionConfig()
    """Speeds along the path."""
    arm: str | None = None
    """Host of the controller of the carrying arm; before its first state, whiskers are in free air."""
    arm_hz: PositiveInt = 125
    """Rate of the arm's states, Hz."""
    placing: BaseTransformConfig = BaseTransformConfig()
    """Pose of the map in the arm's base frame."""
    follow: bool = False
    """Without an arm: whether the head moves along the path from its first START on, or stays at its start.
    """

    @model_validator(mode="after")
    def _one_leads(self) -> HeadEmulatorConfig:
        if self.follow and self.arm is not None:
            raise ValueError("`follow` and `arm` exclude each other; give one of them")
        return self
