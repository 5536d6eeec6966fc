"""Modes and status bits of the controller. Source: tables of the vendor's RTDE guide."""

from __future__ import annotations

from enum import IntEnum, IntFlag


class SafetyMode(IntEnum):
    """Safety mode: the reason why the arm may not move, if any."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7


class RobotMode(IntEnum):
    """Power state of the arm."""

    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


class Runtime(IntEnum):
    """State of the program."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class SafetyBits(IntFlag):
    """`safety_status_bits`."""

    NORMAL = 1 << 0
    PROTECTIVE_STOPPED = 1 << 2
    SAFEGUARD_STOPPED = 1 << 4
    ROBOT_EMERGENCY_STOPPED = 1 << 6
    EMERGENCY_STOPPED = 1 << 7
    STOPPED_DUE_TO_SAFETY = 1 << 10


class StatusBits(IntFlag):
    """`robot_status_bits`."""

    POWER_ON = 1 << 0
    PROGRAM_RUNNING = 1 << 1


BITS = {
    SafetyMode.NORMAL: SafetyBits.NORMAL,
    SafetyMode.PROTECTIVE_STOP: SafetyBits.PROTECTIVE_STOPPED | SafetyBits.STOPPED_DUE_TO_SAFETY,
    SafetyMode.SAFEGUARD_STOP: SafetyBits.SAFEGUARD_STOPPED | SafetyBits.STOPPED_DUE_TO_SAFETY,
    SafetyMode.ROBOT_EMERGENCY_STOP: SafetyBits.ROBOT_EMERGENCY_STOPPED
    | SafetyBits.EMERGENCY_STOPPED
    | SafetyBits.STOPPED_DUE_TO_SAFETY,
}
