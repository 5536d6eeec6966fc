"""What an emulated head is made from."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, NonNegativeInt, PositiveInt, model_validator

from robot.drivers.head.usb_tcp_protocol import PORT
from robot.drivers.ur10.base_transform import BaseTransformConfig
from robot.simulation.head.beam import StreamConfig
from robot.simulation.head.kinematic import MechanicsConfig
from robot.world.head_trajectory import MotionConfig
from robot.world.scene import MazeConfig, PathConfig
from tactile.base.config import Settings
from tactile.whiskers.head_geometry import HeadConfig

CONTROL_PORT = 30099
"""Where faults are asked for."""


class HeadEmulatorConfig(Settings):
    """A head that is not there, in a maze that is not there."""

    host: str = "127.0.0.1"
    """Address to listen at."""
    port: Annotated[int, Field(ge=0, le=65535)] = PORT
    """Of what stands for its USB."""
    control_port: Annotated[int, Field(ge=0, le=65535)] = CONTROL_PORT
    """Of the faults."""
    head: HeadConfig = HeadConfig()
    """The whiskers."""
    mechanics: MechanicsConfig = MechanicsConfig()
    """Drives, whiskers and sensors."""
    stream: StreamConfig = StreamConfig()
    """Sample rate, saturation, shafts."""
    maze: MazeConfig = MazeConfig()
    """What there is to touch."""
    path: PathConfig = PathConfig()
    """The way that the maze is made for; the head's own where it follows."""
    motion: MotionConfig = MotionConfig()
    """How it would go along it."""
    seed: NonNegativeInt = 0
    """Of the maze, the way and the sensors' noise, by the streams of the simulator."""
    arm: str | None = None
    """Host of the controller whose arm carries the head; until it tells where the tool is, whiskers are in
    free air."""
    arm_hz: PositiveInt = 125
    """Of the arm's states."""
    placing: BaseTransformConfig = BaseTransformConfig()
    """Where the map lies in the arm's base."""
    follow: bool = False
    """Without an arm: whether the head goes along the way from its first START on; else it stays where that
    begins."""
    drift_ppm: Annotated[float, Field(ge=-1000, le=1000)] = 0.0
    """By how much its clock is fast."""
    age: Annotated[float, Field(ge=0)] = 0.0
    """For how long it has had power when it begins, s of its clock; 4294.967 s on, times wrap, and at 2 kHz
    numbers of samples 2147483.6 s on."""
    fifo: PositiveInt = 4096
    """Frames it holds for a host that does not read."""

    @model_validator(mode="after")
    def _one_leads(self) -> HeadEmulatorConfig:
        if self.follow and self.arm is not None:
            raise ValueError("`follow` is for a head without an `arm`; give one of them")
        return self
