"""Settings of a Create (port, speed and time limits), its speed limit, and the reasons that stop it."""

from __future__ import annotations

import math
from enum import Enum
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, PositiveFloat, model_validator

from robot.drivers.create.protocol import MODELS, TOP_SPEED, WHEEL_BASE, WRAP
from tactile.base.settings import Settings


class CommandRefused(ValueError):
    """A rejected command."""


class CreateConfig(Settings):
    """A Create on a serial port."""

    model: Literal["create1", "create2"] = "create1"
    """The first Create (2007), or the Create 2 and Roombas from the 500s on, whose encoders are read."""
    port: str = "/dev/ttyUSB0"
    """Serial port; on Windows `COM3` or the like."""
    speed: Annotated[float, Field(gt=0, le=TOP_SPEED / 1000)] = 0.2
    """Speed limit of each wheel, m/s."""
    wheel_base: PositiveFloat = WHEEL_BASE
    """Distance between the wheels, m; of a Create 2 0.235."""
    distance_scale: PositiveFloat = 1.0
    """True distance for 1 m that the robot reports; `check robot create` measures it."""
    turn_scale: PositiveFloat = 1.0
    """True turn for 1 rad that the robot reports; likewise."""
    remainders: Literal["unknown", "kept", "lost"] = "unknown"
    """What a Create 1 does with the rest below 1 mm and 1 degree at each reading; likewise. Of a robot that
    loses it, a motion is read once it is long or ends; bumper and mode are read at each poll."""
    wrap: Annotated[int, Field(ge=2**12, le=2**16)] = WRAP
    """Counts after which the encoders of a Create 2 start again; likewise."""
    rate: Annotated[float, Field(ge=5, le=50)] = 20.0
    """Rate of sensor readings, Hz; the motion between two readings is taken as an arc."""
    patience: Annotated[float, Field(ge=0.1, le=5)] = 0.5
    """Time after which a drive command ends unless renewed, s; also the time-out of the watchdog process."""
    silence: Annotated[float, Field(ge=0.1, le=5)] = 0.3
    """Time without a reply after which the link counts as lost and the wheels are stopped, s."""

    replug: PositiveFloat = 60.0
    """Time for which the watchdog process waits for a disconnected port, to stop the robot then, s."""

    @model_validator(mode="before")
    @classmethod
    def _base_of_model(cls, data: Any) -> Any:
        model = MODELS.get(str(data.get("model"))) if isinstance(data, dict) else None
        return {"wheel_base": model.wheel_base, **data} if model else data

    @model_validator(mode="after")
    def _replies_fit(self) -> CreateConfig:
        if self.silence < 2 / self.rate:
            raise ValueError(f"silence of {self.silence:g} s is less than two readings at {self.rate:g} Hz")
        return self

    def wheel_speeds(self, forward: float, turn: float) -> tuple[int, int]:
        """Speeds of right and left wheel, mm/s.

        Args:
            forward: m/s. turn: rad/s, counter-clockwise.

        Raises:
            CommandRefused: not finite, or a wheel faster than `speed`.
        """
        if not (math.isfinite(forward) and math.isfinite(turn)):
            raise CommandRefused(f"forward {forward} m/s, turn {turn} rad/s: not finite")
        apart = turn * self.wheel_base / 2
        right, left = (1000 * speed for speed in (forward + apart, forward - apart))
        if max(abs(right), abs(left)) > 1000 * self.speed + 1e-6:
            raise CommandRefused(
                f"forward {forward:g} m/s, turn {turn:g} rad/s needs a wheel at"
                f" {max(abs(right), abs(left)) / 1000:g} m/s; the limit is {self.speed:g} (`speed`)"
            )
        cap = math.floor(1000 * self.speed + 1e-6)  # rounding must not exceed the limit
        return max(-cap, min(cap, round(right))), max(-cap, min(cap, round(left)))


class StopReason(Enum):
    """Reason of a stop of the wheels; the value is its cure."""

    BUMPED = "`release` it and drive back"
    WHEEL_DROP = "set it on its wheels, then `release` it"
    LEFT_SAFE_MODE = "a cliff, the charger or a button ended safe mode: check the robot, then `release` it"
    SILENT = "no replies: check battery and cable; the robot may still drive"
    GARBLED = "invalid replies: check the cable, and whether another program reads the port"
    UNPLUGGED = "the robot may still roll: lift it or plug it in, which stops it, then start again"
    UNGUARDED = "the watchdog process hangs or has ended, or the control thread has: start again"


class StopEvent(NamedTuple):
    """A stop of the robot: its reason, the finding, and its time, s on the host's monotonic clock."""

    reason: StopReason
    detail: str
    time: float

    def __str__(self) -> str:
        return f"{self.reason.name.lower()}: {self.detail}; {self.reason.value}"
