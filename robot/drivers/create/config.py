"""How a Create is reached, and how far it is trusted."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, PositiveFloat, model_validator

from robot.drivers.create.protocol import TOP_SPEED, WHEEL_BASE
from tactile.base.config import Settings


class CreateConfig(Settings):
    """A Create on a serial port."""

    port: str = "/dev/ttyUSB0"
    """The serial port, on Windows `COM3` or the like."""
    speed: Annotated[float, Field(gt=0, le=TOP_SPEED / 1000)] = 0.2
    """No wheel is ever told to be faster, m/s."""
    wheel_base: PositiveFloat = WHEEL_BASE
    """Between the wheels, m."""
    rate: Annotated[float, Field(ge=5, le=50)] = 20.0
    """How often sensors are read, Hz. Between two readings it is taken to drive an arc."""
    patience: Annotated[float, Field(ge=0.1, le=5)] = 0.5
    """A command to drive that is not renewed for so long ends, s; a program that is killed or hangs is
    noticed as late."""
    silence: Annotated[float, Field(ge=0.1, le=5)] = 0.3
    """Without a reply for so long the link is lost, and the wheels are stopped, s."""

    @model_validator(mode="after")
    def _replies_fit(self) -> CreateConfig:
        if self.silence < 2 / self.rate:
            raise ValueError(f"silence of {self.silence:g} s is less than two readings at {self.rate:g} Hz")
        return self
