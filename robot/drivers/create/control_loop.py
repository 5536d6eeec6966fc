"""Control loop of the Create: read sensors, check, command the wheels."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import NamedTuple

from robot.drivers.create import protocol
from robot.drivers.create.config import CreateConfig
from robot.drivers.create.odometry import CreateOdometry
from robot.drivers.create.serial_link import BadReply, LinkCounts, NoReply, SerialLink, Unplugged
from robot.drivers.create.stop_reasons import CommandRefused, StopEvent, StopReason, stop_reason, wheel_speeds
from tactile.base.types import Odometry

PAUSE = 0.03
"""Pause between commands that change the mode, s; within 20 ms of one the robot may miss the next."""


class WheelCommand(NamedTuple):
    """Requested wheel speeds, mm/s, and the time of the request, s."""

    right: int
    left: int
    time: float


class ControlLoop:
    """Reads, checks, commands, in this order, so that wheels never move without a recent reading.

    One thread polls; others may call `steer`, `take_odometry` and `release` at any time. The robot must be
    awake, in safe mode, with cleared counters.

    Args:
        clock: returns the host's monotonic time, s.
    """

    def __init__(self, config: CreateConfig, link: SerialLink, clock: Callable[[], float]) -> None:
        self._config, self._link, self._clock = config, link, clock
        self._lock = threading.Lock()
        self._asked = WheelCommand(0, 0, -math.inf)
        self._heard = clock()
        self._odometer = CreateOdometry(self._heard)
        self._owed = 0  # at the last call of `gap`
        self._rearm, self._deaf = False, -math.inf
        self.halted: StopEvent | None = None
        self.sensed: protocol.SensorReply | None = None

    @property
    def counts(self) -> LinkCounts:
        """Counts of queries so far."""
        return self._link.counts

    def steer(self, forward: float, turn: float) -> None:
        """Requests a motion, m/s and rad/s; it ends after `patience`.

        Raises:
            CommandRefused: above the speed limit, not finite, or stopped and not released.
        """
        right, left = wheel_speeds(self._config, forward, turn)
        with self._lock:
            if self.halted and (right or left):
                raise CommandRefused(f"the robot is stopped: {self.halted}")
            self._asked = WheelCommand(right, left, self._clock())

    def release(self) -> None:
        """Allows driving again after a stop; the robot stands until the next command.

        Raises:
            CommandRefused: a lost port or watchdog requires a new driver.
        """
        with self._lock:
            if self.halted and self.halted.halt in (StopReason.UNPLUGGED, StopReason.UNGUARDED):
                raise CommandRefused(f"a new driver is required: {self.halted}")
            self._rearm = self.halted is not None
            self.halted = None

    def take_odometry(self) -> Odometry:
        """Motion since the last call."""
        with self._lock:
            return self._odometer.take_odometry()

    def gap(self) -> bool:
        """Whether a reply was lost since the last call, possibly with its motion."""
        with self._lock:
            before, self._owed = self._owed, self._link.counts.owed
            return self._owed > before

    def halt(self, halt: StopReason, detail: str) -> None:
        """Stops the robot with the next poll, until release; the first reason is kept."""
        with self._lock:
            self._asked = WheelCommand(0, 0, -math.inf)
            self.halted = self.halted or StopEvent(halt, detail, self._clock())

    def poll(self) -> None:
        """Reads the sensors and commands the wheels."""
        if self._clock() < self._deaf:
            return
        try:
            if self._rearm:
                self._rearm, self._deaf = False, self._clock() + PAUSE
                self._link.send(protocol.SAFE)
                return
            found = self._read()
            asked = self._asked  # read once: another thread may replace it
            objected = stop_reason(found, asked.right, asked.left) if found else None
            if objected:
                self.halt(*objected)
            fresh = self._clock() - asked.time <= self._config.patience
            drives = fresh and self.halted is None
            self._link.send(protocol.drive(asked.right, asked.left) if drives else protocol.STOP)
        except Unplugged as error:
            self.halt(StopReason.UNPLUGGED, str(error))

    def _read(self) -> protocol.SensorReply | None:
        try:
            found = self._link.ask(self._clock() - self._heard)
        except (NoReply, BadReply) as error:
            since = self._clock() - self._heard
            if since >= self._config.silence:
                halt = StopReason.SILENT if isinstance(error, NoReply) else StopReason.GARBLED
                self.halt(halt, f"{error} for {since:.2f} s")
            return None
        with self._lock:
            self._heard, self.sensed = self._clock(), found
            self._odometer.add(found.millimetres, found.degrees, self._heard)
        return found
