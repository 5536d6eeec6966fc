"""Byte protocol of the Open Interface of the Create 1 and 2: the commands sent and the replies read.

Sources: iRobot Create Open Interface (2006), iRobot Create 2 Open Interface (2015): 8N1; numbers are
big-endian. Neither commands nor replies have a header or a checksum, so a reply is accepted only if its
values are possible.
"""

from __future__ import annotations

import math
import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

TOP_SPEED = 500
"""Highest wheel speed of the interface, mm/s."""
WHEEL_BASE = 0.258
"""Distance between the wheels of the Create 1, m."""
COUNT = math.pi * 72.0 / 508.8
"""Way of a wheel of the Create 2 for one count of its encoder, mm."""
WRAP = 2**16
"""Counts after which an encoder starts again."""

START = bytes([128])
"""Starts the interface; from any other mode it enters `PASSIVE`, with motors off."""
SAFE = bytes([131])
DRIVE_DIRECT = 145
QUERY = bytes([149, 4, 19, 20, 7, 35])
"""Query of distance, angle, bumps and wheel drops, and mode."""
REPLY = struct.Struct(">hhBB")
STATE_QUERY = bytes([149, 6, 37, 37, 37, 37, 7, 35])
"""A query that clears no counter, with a reply of the same layout: no song plays, so its motion is 0."""
_WHEELS = struct.Struct(">Bhh")

TURN_PER_SECOND = 222
"""Highest turning rate, degrees/s: both wheels at `TOP_SPEED`, opposed."""
MAX_DELAY = 0.1
"""Motion time that a reply may report beyond the elapsed time, s, after a delay in a buffer."""
MOST_LIGHT = 4095
"""Largest signal of a light bumper."""
LIGHTS = (65.0, 38.0, 13.0, -13.0, -38.0, -65.0)
"""Directions of the light bumpers, from the left to the right, degrees counter-clockwise from ahead."""
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
        millimetres: mean of both wheels, forward. degrees: counter-clockwise; both 0 of a Create 2.
        encoders: counts of left and right wheel. light: six light bumpers, from the left to the right, 0 to
            `MOST_LIGHT` (something near); both only of a Create 2.
    """

    millimetres: int
    degrees: int
    bumps: Bumps
    mode: Mode
    encoders: tuple[int, int] | None = None
    light: tuple[int, ...] = ()


class CreateModel(NamedTuple):
    """How a model of the Create is asked.

    Attributes:
        baud: of its port. wheel_base: distance between the wheels, m. query: what it is asked. reply: layout
            of the answer.
    """

    baud: int
    wheel_base: float
    query: bytes
    reply: struct.Struct

    def parse(self, data: bytes, elapsed: float) -> SensorReply | None:
        """The reply in these bytes; None if it cannot be one of this robot.

        Args:
            elapsed: s since the last accepted reply; inf without one.
        """
        if len(data) != self.reply.size:
            return None
        first, second, bumps, mode, *light = self.reply.unpack(data)
        if mode not in (Mode.PASSIVE, Mode.SAFE, Mode.FULL) or bumps > Bumps.BUMPED | Bumps.DROPPED:
            return None
        state, time = (Bumps(bumps), Mode(mode)), elapsed + MAX_DELAY
        if light:
            possible = max(light) <= MOST_LIGHT
            return SensorReply(0, 0, *state, (first, second), tuple(light)) if possible else None
        possible = abs(first) <= TOP_SPEED * time + NUDGE and abs(second) <= TURN_PER_SECOND * time + NUDGE
        return SensorReply(first, second, *state) if possible else None


MODELS = {
    "create1": CreateModel(57600, WHEEL_BASE, QUERY, REPLY),
    "create2": CreateModel(
        115200, 0.235, bytes([149, 10, 43, 44, 7, 35, 46, 47, 48, 49, 50, 51]), struct.Struct(">HHBB6H")
    ),
}
"""The models by their names in `live.create.model`."""


def drive(right: int, left: int) -> bytes:
    """The command that sets both wheel speeds, mm/s. It holds until the next: the robot has no watchdog."""
    if max(abs(right), abs(left)) > TOP_SPEED:
        raise ValueError(f"wheels at {right} and {left} mm/s; the limit of the Create is {TOP_SPEED}")
    return _WHEELS.pack(DRIVE_DIRECT, right, left)


STOP = drive(0, 0)
STOP_ANYHOW = bytes(4) + STOP
"""Stops even after an incomplete command: the zeros complete it, and have no effect otherwise."""
