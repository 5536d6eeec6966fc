"""Byte protocol of the Create's Open Interface: the commands sent and the one reply read.

Source: iRobot Create Open Interface (2006): 57600 baud, 8N1; numbers are big-endian. Neither commands nor
replies have a header or a checksum, so a reply is accepted only if its values are possible.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

BAUD = 57600
TOP_SPEED = 500
"""Highest wheel speed of the interface, mm/s."""
WHEEL_BASE = 0.258
"""Distance between the wheels, m."""

START = bytes([128])
"""Starts the interface; from any other mode it enters `PASSIVE`, with motors off."""
SAFE = bytes([131])
DRIVE_DIRECT = 145
QUERY = bytes([149, 4, 19, 20, 7, 35])
"""Query of distance, angle, bumps and wheel drops, and mode."""
REPLY = struct.Struct(">hhBB")
_WHEELS = struct.Struct(">Bhh")

TURN_PER_SECOND = 222
"""Highest turning rate, degrees/s: both wheels at `TOP_SPEED`, opposed."""
MAX_DELAY = 0.1
"""Motion time that a reply may report beyond the elapsed time, s, after a delay in a buffer."""
NUDGE = 5
"""Largest reported motion of a robot at rest, mm or degrees."""


class Mode(IntEnum):
    """Modes of the interface."""

    OFF = 0
    PASSIVE = 1
    """Sensors only; the motors are off."""
    SAFE = 2
    """Full control until a wheel drops, a cliff is seen or the charger is connected: then `PASSIVE`."""
    FULL = 3


class Bumps(IntFlag):
    """Packet 7."""

    RIGHT = 1
    LEFT = 2
    DROPPED_RIGHT = 4
    DROPPED_LEFT = 8
    DROPPED_CASTER = 16

    BUMPED = RIGHT | LEFT
    DROPPED = DROPPED_RIGHT | DROPPED_LEFT | DROPPED_CASTER

    def describe(self) -> str:
        """Bumps and wheel drops in words."""
        return " and ".join(str(bump.name).lower().replace("_", " ") for bump in self) or "nothing touched"


class SensorReply(NamedTuple):
    """One reply; distance and angle are those since the previous reply.

    Attributes:
        millimetres: mean of both wheels, forward. degrees: counter-clockwise.
    """

    millimetres: int
    degrees: int
    bumps: Bumps
    mode: Mode

    @classmethod
    def parse(cls, data: bytes, elapsed: float) -> SensorReply | None:
        """The reply in these bytes; None if it cannot be one of a Create.

        Args:
            elapsed: s since the last accepted reply; inf without one.
        """
        if len(data) != REPLY.size:
            return None
        millimetres, degrees, bumps, mode = REPLY.unpack(data)
        time = elapsed + MAX_DELAY
        believable = (
            mode in (Mode.PASSIVE, Mode.SAFE, Mode.FULL)
            and bumps <= Bumps.BUMPED | Bumps.DROPPED
            and abs(millimetres) <= TOP_SPEED * time + NUDGE
            and abs(degrees) <= TURN_PER_SECOND * time + NUDGE
        )
        return cls(millimetres, degrees, Bumps(bumps), Mode(mode)) if believable else None


def drive(right: int, left: int) -> bytes:
    """The command that sets both wheel speeds, mm/s. It holds until the next: the robot has no watchdog."""
    if max(abs(right), abs(left)) > TOP_SPEED:
        raise ValueError(f"wheels at {right} and {left} mm/s; the limit of the Create is {TOP_SPEED}")
    return _WHEELS.pack(DRIVE_DIRECT, right, left)


STOP = drive(0, 0)
STOP_ANYHOW = bytes(4) + STOP
"""Stops even after an incomplete command: the zeros complete it, and have no effect otherwise."""
