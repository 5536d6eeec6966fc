"""The arm's settings: where it is, where it may go and how fast, and when it counts as lost."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, model_validator

from robot.drivers.ur10.base_transform import BaseTransformConfig
from tactile.base.config import Settings

SPEED_CAP = 0.25  # m/s; ISO 10218-1's reduced speed. No setting reaches beyond it
TURN_CAP = 1.0  # rad/s

Corner = tuple[float, float, float]


class BoxConfig(Settings):
    """The workspace: where the tool centre point may be, in the base frame."""

    low: Corner = (-0.75, 0.15, 0.05)
    """The corner of smallest x, y, z, m."""
    high: Corner = (0.75, 1.25, 0.45)
    """The corner of largest x, y, z, m."""

    @model_validator(mode="after")
    def _ordered(self) -> BoxConfig:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"low {self.low} must be smaller than high {self.high} in every coordinate")
        return self


class ArmConfig(Settings):
    """A UR-10 (CB3 or e-Series) and what it may do, beside the robot's own safety configuration."""

    host: str = "127.0.0.11"
    """The controller's address; its ports are fixed. The default is the emulator's."""
    hz: Literal[125, 500] = 125
    """Rate of the state stream: 125 of a CB3, 500 of an e-Series (which does 125 as well)."""
    placing: BaseTransformConfig = BaseTransformConfig()
    """Where the map lies in the base frame."""
    box: BoxConfig = BoxConfig()
    """Checked on every target and on every state."""
    speed: Annotated[float, Field(gt=0, le=SPEED_CAP)] = 0.05
    """Of the tool centre point, m/s; a move may be slower."""
    turn_rate: Annotated[float, Field(gt=0, le=TURN_CAP)] = 0.4
    """Of the tool on the spot, rad/s."""
    turn_ratio: Annotated[float, Field(ge=4, le=100)] = 4.0
    """rad/s by which a controller turns the tool for every m/s it is told, at most. A guess, confirmed by no
    controller: one that turns more slowly takes longer, which is allowed for."""
    acceleration: Annotated[float, Field(gt=0, le=1.2)] = 0.3
    """Of the tool, m/s^2."""
    deceleration: Annotated[float, Field(gt=0, le=10.0)] = 2.0
    """In a controlled stop, m/s^2."""
    tilt_deg: Annotated[float, Field(ge=0, le=90)] = 5.0
    """By how much a target's tool may lean from straight down, degrees."""
    tool: tuple[float, float, float, float, float, float] | None = None
    """The tool centre point on the flange (m and a rotation vector); none: as the installation has it."""
    force_limit: PositiveFloat = 30.0
    """Force at the tool that counts as a contact when two states in a row show it, N."""
    backoff: Annotated[float, Field(ge=0, le=0.05)] = 0.01
    """How far the tool goes back the way it came after a contact, m."""
    stale: Annotated[float, Field(gt=0, le=1.0)] = 0.1
    """Age of the newest state beyond which the arm counts as lost, s."""
    heartbeat: Annotated[float, Field(gt=0, le=1.0)] = 0.15
    """Age of the session's last sign of life beyond which the arm's process stops the arm and ends, s."""
    watchdog_hz: Annotated[float, Field(ge=2, le=100)] = 10.0
    """The controller stops the arm by itself when it hears less often."""
    arrive: PositiveFloat = 0.001
    """How near to its target an arm that arrived must stand, m."""
    arrive_turn_deg: PositiveFloat = 0.5
    """The same for its heading, degrees."""
    patience: PositiveFloat = 3.0
    """Beyond the time that a move should take before the arm counts as not arrived, s."""
    connect: PositiveFloat = 10.0
    """How long the controller may take to answer and take the control script, s."""
