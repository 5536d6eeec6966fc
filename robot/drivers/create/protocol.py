"""The Create's Open Interface as bytes: the few commands that are sent, and the one reply that is read.

Source: iRobot Create Open Interface (2006): 57600 baud, 8N1; numbers are big-endian. Neither commands nor
replies carry a header or a checksum, so a reply is believed only if it is one that the robot can give.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

BAUD = 57600
TOP_SPEED = 500
"""mm/s of a wheel, the most the interface takes."""
WHEEL_BASE = 0.258
"""m between the wheels."""

START = bytes([128])
"""Wakes the interface; from any other mode it leads to `PASSIVE`, where the motors are off."""
SAFE = bytes([131])
DRIVE_DIRECT = 145
QUERY = bytes([149, 4, 19, 20, 7, 35])
"""Asks for distance, angle, bumps and wheel drops, and mode."""
REPLY = struct.Struct(">hhBB")
_WHEELS = struct.Struct(">Bhh")

TURN_PER_SECOND = 222
"""Degrees: both wheels at `TOP_SPEED`, opposed."""
MAX_DELAY = 0.1
"""s of motion that a reply may tell beyond the time that has passed: it stood in a buffer on its way."""
NUDGE = 5
"""mm or degrees that a reply may tell of a robot that stands: it was nudged."""


class Mode(IntEnum):
    """What the interface allows."""

    OFF = 0
    PASSIVE = 1
    """Sensors only; the motors are off."""
    SAFE = 2
    """All, until a wheel drops, a cliff is seen or the charger is plugged in: then `PASSIVE`."""
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


class SensorReply(NamedTuple):
    """One reply. Distance and angle are what was driven since the reply before: reading clears them.

    Attributes:
        millimetres: mean of both wheels, forward. degrees: counter-clockwise.
    """

    millimetres: int
    degrees: int
    bumps: Bumps
    mode: Mode


def drive(right: int, left: int) -> bytes:
    """The command that sets both wheels, mm/s. It holds until the next: the robot has no watchdog."""
    if max(abs(right), abs(left)) > TOP_SPEED:
        raise ValueError(f"wheels at {right} and {left} mm/s; the Create takes {TOP_SPEED} at most")
    return _WHEELS.pack(DRIVE_DIRECT, right, left)


STOP = drive(0, 0)
STOP_ANYHOW = bytes(4) + STOP
"""Stops also after a command that broke off: the zeros are what it lacked, and by themselves mean nothing."""


def parse_reply(data: bytes, elapsed: float) -> SensorReply | None:
    """The reply, or None if no Create says so.

    Args:
        elapsed: s since the last reply that was believed; inf if there is none.
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
    return SensorReply(millimetres, degrees, Bumps(bumps), Mode(mode)) if believable else None


def describe_bumps(bumps: Bumps) -> str:
    """Bumps and drops in words."""
    return " and ".join(str(bump.name).lower().replace("_", " ") for bump in bumps) or "nothing touched"
