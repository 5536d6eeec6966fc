"""Reasons that stop a Create, each with its cure; the speed limit."""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from robot.drivers.create.config import CreateConfig
from robot.drivers.create.protocol import Bumps, Mode, SensorReply, describe_bumps


class StopReason(Enum):
    """Why the wheels were stopped; the value tells what to do."""

    BUMPED = "`release` it and drive back"
    WHEEL_DROP = "set it on its wheels, then `release` it"
    LEFT_SAFE_MODE = "a cliff, its charger or a button ended safe mode: look at it, then `release` it"
    SILENT = "replies stopped coming: look at its battery and cable; it may still drive"
    GARBLED = "what comes is no reply of a Create: look at the cable, and whether another program reads it"
    UNPLUGGED = "the port is gone, and it may still drive: lift it, plug the cable in, start again"
    UNGUARDED = "the process that stops it when this one is killed has ended: start again"


class StopEvent(NamedTuple):
    """A stop of the robot.

    Attributes:
        halt: which reason. detail: what was found. time: s, host's monotonic clock.
    """

    halt: StopReason
    detail: str
    time: float

    def __str__(self) -> str:
        return f"{self.halt.name.lower()}: {self.detail}; {self.halt.value}"


class CommandRefused(ValueError):
    """A command that is rejected."""


def wheel_speeds(config: CreateConfig, forward: float, turn: float) -> tuple[int, int]:
    """Speeds of right and left wheel, mm/s.

    Args:
        forward: m/s. turn: rad/s, counter-clockwise.

    Raises:
        CommandRefused: not finite, or a wheel faster than `config.speed`.
    """
    if not (math.isfinite(forward) and math.isfinite(turn)):
        raise CommandRefused(f"forward {forward} m/s, turn {turn} rad/s: not finite")
    apart = turn * config.wheel_base / 2
    right, left = (1000 * speed for speed in (forward + apart, forward - apart))
    if max(abs(right), abs(left)) > 1000 * config.speed + 1e-6:
        raise CommandRefused(
            f"forward {forward:g} m/s, turn {turn:g} rad/s needs a wheel at"
            f" {max(abs(right), abs(left)) / 1000:g} m/s; the cap is {config.speed:g} (`speed`)"
        )
    cap = math.floor(1000 * config.speed + 1e-6)  # rounding must not exceed the limit
    return max(-cap, min(cap, round(right))), max(-cap, min(cap, round(left)))


def stop_reason(sensed: SensorReply, right: int, left: int) -> tuple[StopReason, str] | None:
    """Why the wheels must stop, from a reading, or None. After a bump, driving back is allowed."""
    if sensed.bumps & Bumps.DROPPED:
        return StopReason.WHEEL_DROP, describe_bumps(sensed.bumps & Bumps.DROPPED)
    if sensed.mode != Mode.SAFE:
        return StopReason.LEFT_SAFE_MODE, f"it is in {sensed.mode.name.lower()} mode"
    if sensed.bumps & Bumps.BUMPED and right + left > 0:
        return StopReason.BUMPED, describe_bumps(sensed.bumps & Bumps.BUMPED)
    return None
