"""Settings of a Create: port, speed and time limits."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, PositiveFloat, model_validator

from robot.drivers.create.protocol import TOP_SPEED, WHEEL_BASE
from tactile.base.settings import Settings


class CreateConfig(Settings):
    """A Create on a serial port."""

    port: str = "/dev/ttyUSB0"
    """Serial port; on Windows `COM3` or the like."""
    speed: Annotated[float, Field(gt=0, le=TOP_SPEED / 1000)] = 0.2
    """Speed limit of each wheel, m/s."""
    wheel_base: PositiveFloat = WHEEL_BASE
    """Distance between the wheels, m."""
    rate: Annotated[float, Field(ge=5, le=50)] = 20.0
    """Rate of sensor readings, Hz; the motion between two readings is taken as an arc."""
    patience: Annotated[float, Field(ge=0.1, le=5)] = 0.5
    """Time after which a drive command ends unless renewed, s; also the time-out of the watchdog process."""
    silence: Annotated[float, Field(ge=0.1, le=5)] = 0.3
    """Time without a reply after which the link counts as lost and the wheels are stopped, s."""

    replug: PositiveFloat = 60.0
    """Time for which the watchdog process waits for a disconnected port, to stop the robot then, s."""

    @model_validator(mode="after")
    def _replies_fit(self) -> CreateConfig:
        if self.silence < 2 / self.rate:
            raise ValueError(f"silence of {self.silence:g} s is less than two readings at {self.rate:g} Hz")
        return self
