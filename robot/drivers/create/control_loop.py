"""Control loop of the Create: read sensors, check, command the wheels.

Odometry from the whole millimetres and degrees that the Create reports.

The robot keeps the remainder below 1 mm and 1 degree for the next reply. Unless a reply is lost, sums
stay within these bounds of the wheels' motion, at any reading rate.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import NamedTuple

from robot.drivers.create import protocol
from robot.drivers.create.driver_config import CreateConfig
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
        self._command = WheelCommand(0, 0, -math.inf)
        self._reply_time = clock()
        self._odometer = CreateOdometry(self._reply_time)
        self._outstanding = 0  # at the last call of `gap`
        self._enter_safe, self._pause_end = False, -math.inf
        self.active_stop: StopEvent | None = None
        self.last_reply: protocol.SensorReply | None = None

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
            if self.active_stop and (right or left):
                raise CommandRefused(f"the robot is stopped: {self.active_stop}")
            self._command = WheelCommand(right, left, self._clock())

    def release(self) -> None:
        """Allows driving again after a stop; the robot stands until the next command.

        Raises:
            CommandRefused: a lost port or watchdog requires a new driver.
        """
        with self._lock:
            if self.active_stop and self.active_stop.reason in (StopReason.UNPLUGGED, StopReason.UNGUARDED):
                raise CommandRefused(f"a new driver is required: {self.active_stop}")
            self._enter_safe = self.active_stop is not None
            self.active_stop = None

    def take_odometry(self) -> Odometry:
        """Motion since the last call."""
        with self._lock:
            return self._odometer.take_odometry()

    def gap(self) -> bool:
        """Whether a reply was lost since the last call, possibly with its motion."""
        with self._lock:
            before, self._outstanding = self._outstanding, self._link.counts.outstanding
            return self._outstanding > before

    def halt(self, reason: StopReason, detail: str) -> None:
        """Stops the robot with the next poll, until release; the first reason is kept."""
        with self._lock:
            self._command = WheelCommand(0, 0, -math.inf)
            self.active_stop = self.active_stop or StopEvent(reason, detail, self._clock())

    def poll(self) -> None:
        """Reads the sensors and commands the wheels."""
        if self._clock() < self._pause_end:
            return
        try:
            if self._enter_safe:
                self._enter_safe, self._pause_end = False, self._clock() + PAUSE
                self._link.send(protocol.SAFE)
                return
            found = self._read()
            command = self._command  # read once: another thread may replace it
            stop = stop_reason(found, command.right, command.left) if found else None
            if stop:
                self.halt(*stop)
            fresh = self._clock() - command.time <= self._config.patience
            drives = fresh and self.active_stop is None
            self._link.send(protocol.drive(command.right, command.left) if drives else protocol.STOP)
        except Unplugged as error:
            self.halt(StopReason.UNPLUGGED, str(error))

    def _read(self) -> protocol.SensorReply | None:
        try:
            found = self._link.ask(self._clock() - self._reply_time)
        except (NoReply, BadReply) as error:
            since = self._clock() - self._reply_time
            if since >= self._config.silence:
                reason = StopReason.SILENT if isinstance(error, NoReply) else StopReason.GARBLED
                self.halt(reason, f"{error} for {since:.2f} s")
            return None
        with self._lock:
            self._reply_time, self.last_reply = self._clock(), found
            self._odometer.add(found.millimetres, found.degrees, self._reply_time)
        return found


class CreateOdometry:
    """Accumulates readings until they are taken.

    Args:
        time: host time of the reading that cleared the robot's counters, s.
    """

    def __init__(self, time: float) -> None:
        self._taken = self._time = time
        self._x = self._y = 0.0
        self._degrees = 0  # an integer, so that the sum is exact

    def add(self, millimetres: int, degrees: int, time: float) -> None:
        """Adds a reading (mm, degrees, host time s): an arc since the previous one."""
        turned, turn = math.radians(self._degrees), math.radians(degrees)
        chord = millimetres / 1000 * (math.sin(turn / 2) / (turn / 2) if turn else 1.0)
        self._x += chord * math.cos(turned + turn / 2)
        self._y += chord * math.sin(turned + turn / 2)
        self._degrees += degrees
        self._time = time

    def take_odometry(self) -> Odometry:
        """Motion since the last call; dt ends at the last reading. The turn is not wrapped."""
        motion = Odometry(self._x, self._y, math.radians(self._degrees), self._time - self._taken)
        self._taken, self._x, self._y, self._degrees = self._time, 0.0, 0.0, 0
        return motion
