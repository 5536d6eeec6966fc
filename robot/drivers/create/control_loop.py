"""One reading of the Create after the other, and what the wheels are told after it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import NamedTuple

from robot.drivers.create import protocol
from robot.drivers.create.config import CreateConfig
from robot.drivers.create.odometry import Odometer
from robot.drivers.create.serial_link import Counts, Garbled, Link, Silent, Unplugged
from robot.drivers.create.stop_reasons import Halt, Halted, Refused, objection, wheels
from tactile.base.types import Odometry

PAUSE = 0.03
"""s between commands that change the mode; within 20 ms of one the robot may miss the next."""


class Asked(NamedTuple):
    """What the wheels are asked for, mm/s, and when, s."""

    right: int
    left: int
    time: float


class Pilot:
    """Reads, objects, drives: in this order, so that wheels never turn on what was not just looked at.

    One thread polls; others may `steer`, `take` and `release` at any time.

    The robot is awake, in safe mode, and its counters were cleared just now.

    Args:
        clock: s, monotonic.
    """

    def __init__(self, config: CreateConfig, link: Link, clock: Callable[[], float]) -> None:
        self._config, self._link, self._clock = config, link, clock
        self._lock = threading.Lock()
        self._asked = Asked(0, 0, -math.inf)
        self._heard = clock()
        self._odometer = Odometer(self._heard)
        self._owed = 0  # when last asked
        self._rearm, self._deaf = False, -math.inf
        self.halted: Halted | None = None
        self.sensed: protocol.Sensed | None = None

    @property
    def counts(self) -> Counts:
        """What became of the queries so far."""
        return self._link.counts

    def steer(self, forward: float, turn: float) -> None:
        """Asks for a motion, m/s and rad/s; it ends by itself after `patience`.

        Raises:
            Refused: over the cap, not finite, or something has stopped it and was not released.
        """
        right, left = wheels(self._config, forward, turn)
        with self._lock:
            if self.halted and (right or left):
                raise Refused(f"it was stopped, {self.halted}")
            self._asked = Asked(right, left, self._clock())

    def release(self) -> None:
        """Lets it be driven again after something stopped it; it stands until it is told to drive.

        Raises:
            Refused: the port or the guard is gone; that takes a new driver.
        """
        with self._lock:
            if self.halted and self.halted.halt in (Halt.UNPLUGGED, Halt.UNGUARDED):
                raise Refused(f"cannot go on, {self.halted}")
            self._rearm = self.halted is not None
            self.halted = None

    def take(self) -> Odometry:
        """Motion since the last time it was taken."""
        with self._lock:
            return self._odometer.take()

    def gap(self) -> bool:
        """Whether, since this was last asked, a reply was lost, and perhaps the motion it told."""
        with self._lock:
            before, self._owed = self._owed, self._link.counts.owed
            return self._owed > before

    def halt(self, halt: Halt, detail: str) -> None:
        """Stops it, at the latest with the next poll, until it is released. The first reason stays."""
        with self._lock:
            self._asked = Asked(0, 0, -math.inf)
            self.halted = self.halted or Halted(halt, detail, self._clock())

    def poll(self) -> None:
        """Reads, and tells the wheels what is allowed."""
        if self._clock() < self._deaf:
            return
        try:
            if self._rearm:
                self._rearm, self._deaf = False, self._clock() + PAUSE
                self._link.send(protocol.SAFE)
                return
            found = self._read()
            asked = self._asked  # another thread may put a new one: what is looked at is what is sent
            objected = objection(found, asked.right, asked.left) if found else None
            if objected:
                self.halt(*objected)
            fresh = self._clock() - asked.time <= self._config.patience
            drives = fresh and self.halted is None
            self._link.send(protocol.drive(asked.right, asked.left) if drives else protocol.STOP)
        except Unplugged as error:
            self.halt(Halt.UNPLUGGED, str(error))

    def _read(self) -> protocol.Sensed | None:
        try:
            found = self._link.ask(self._clock() - self._heard)
        except (Silent, Garbled) as error:
            since = self._clock() - self._heard
            if since >= self._config.silence:
                halt = Halt.SILENT if isinstance(error, Silent) else Halt.GARBLED
                self.halt(halt, f"{error} for {since:.2f} s")
            return None
        with self._lock:
            self._heard, self.sensed = self._clock(), found
            self._odometer.add(found.millimetres, found.degrees, self._heard)
        return found
