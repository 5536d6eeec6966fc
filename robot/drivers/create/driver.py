"""Driver of a Create: a control thread, and a watchdog process for the end of that thread.

The thread reads the sensors, checks them and commands the wheels, in this order. Odometry sums the whole
millimetres and degrees that a Create 1 reports, or the encoders' counts of a Create 2. A Create 1 that keeps
the remainder below 1 mm and 1 degree for the next reply has sums within these bounds of the wheels' motion,
unless a reply is lost; for one that loses it see `robot.drivers.create.wheel_counters`.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from typing import Self

from robot.drivers.create import protocol
from robot.drivers.create.driver_config import CommandRefused, CreateConfig, StopEvent, StopReason
from robot.drivers.create.protocol import Bumps
from robot.drivers.create.serial_link import BadReply, LinkCounts, NoReply, SerialLink, Unplugged, open_port
from robot.drivers.create.watchdog import Watchdog
from robot.drivers.create.wheel_counters import CreateOdometry, CreateReading, WheelCounters
from tactile.base.errors import InputError
from tactile.base.types import Odometry

PAUSE = 0.03
"""Pause between commands that change the mode, s; within 20 ms of one the robot may miss the next."""


class ControlLoop:
    """Reads, checks, commands, in this order, so that wheels never move without a recent reading.

    One thread polls; others may call `steer`, `take_odometry` and `release` at any time. The robot must be
    awake, in safe mode, with cleared counters.

    Args:
        clock: returns the host's monotonic time, s. tell: called with each reading of the counters, or None.
    """

    def __init__(
        self,
        config: CreateConfig,
        link: SerialLink,
        clock: Callable[[], float],
        tell: Callable[[CreateReading], None] | None = None,
    ) -> None:
        self._config, self.link, self._clock = config, link, clock
        self._lock = threading.Lock()
        self._command = (0, 0, -math.inf)  # requested speeds, right and left, mm/s; time of the request, s
        self._reply_time = self._counted = clock()  # of any reply, and of one with the counters
        self.counters, self._tell = WheelCounters(config, self._reply_time), tell
        self._odometer = CreateOdometry(self._reply_time, (config.distance_scale, config.turn_scale))
        self._outstanding = 0  # at the last call of `gap`
        self._enter_safe, self._pause_end = False, -math.inf
        self.active_stop: StopEvent | None = None
        self.last_reply: protocol.SensorReply | None = None

    def steer(self, forward: float, turn: float) -> None:
        """Requests a motion, m/s and rad/s; it ends after `patience`."""
        right, left = self._config.wheel_speeds(forward, turn)
        with self._lock:
            if self.active_stop and (right or left):
                raise CommandRefused(f"the robot is stopped: {self.active_stop}")
            self._command = (right, left, self._clock())

    def release(self) -> None:
        """Allows driving again after a stop; the robot stands until the next command."""
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
        """Whether a reply was lost since the last call, possibly with its motion; encoders lose none."""
        with self._lock:
            before, self._outstanding = self._outstanding, self.link.counts.outstanding
            return self._outstanding > before and self._config.model == "create1"

    def halt(self, reason: StopReason, detail: str) -> None:
        """Stops the robot with the next poll, until release; the first reason is kept."""
        with self._lock:
            self._command = (0, 0, -math.inf)
            self.active_stop = self.active_stop or StopEvent(reason, detail, self._clock())

    def poll(self) -> None:
        """Reads the sensors and commands the wheels."""
        if self._clock() < self._pause_end:
            return
        try:
            if self._enter_safe:
                self._enter_safe, self._pause_end = False, self._clock() + PAUSE
                self.link.send(protocol.SAFE)
                return
            found = self._read()
            right, left, requested = self._command  # read once: another thread may replace it
            if found is None:
                pass
            elif found.bumps & Bumps.DROPPED:
                self.halt(StopReason.WHEEL_DROP, (found.bumps & Bumps.DROPPED).describe())
            elif found.mode != protocol.Mode.SAFE:
                self.halt(StopReason.LEFT_SAFE_MODE, f"the robot is in {found.mode.name.lower()} mode")
            elif found.bumps & Bumps.BUMPED and right + left > 0:  # driving back is allowed
                self.halt(StopReason.BUMPED, (found.bumps & Bumps.BUMPED).describe())
            if not self._drives(requested):
                right = left = 0
            self.link.send(protocol.drive(right, left))
            self.counters.command(right, left, self._clock())
        except Unplugged as error:
            self.halt(StopReason.UNPLUGGED, str(error))

    def _drives(self, requested: float) -> bool:
        """Whether a command of this time, s, holds now."""
        return self._clock() - requested <= self._config.patience and self.active_stop is None

    def _read(self) -> protocol.SensorReply | None:
        asked, (right, left, requested) = self._clock(), self._command
        query = self.counters.query(*((right, left) if self._drives(requested) else (0, 0)), asked)
        expected = self.counters.expected
        try:
            found = self.link.ask(asked - self._counted, query)
        except (NoReply, BadReply) as error:
            since = self._clock() - self._reply_time
            if since >= self._config.silence:
                reason = StopReason.SILENT if isinstance(error, NoReply) else StopReason.GARBLED
                self.halt(reason, f"{error} for {since:.2f} s")
            return None
        with self._lock:
            self._reply_time, self.last_reply = self._clock(), found
            if query != protocol.STATE_QUERY or found.millimetres or found.degrees:  # else none was asked for
                self._counted = self._reply_time
                if self._tell is not None:
                    self._tell(CreateReading(asked, self._reply_time, expected, found))
                self._odometer.add(*self.counters.read(found), self._reply_time)
        return found


TRIES = 5
"""Number of queries at the start; a Create must answer one of them."""


class NoAnswer(InputError):
    """No Create answers on the port."""


class NotSafe(InputError):
    """The Create does not enter safe mode."""


class CreateDriver:
    """A Create that drives while commands are renewed, and stops otherwise.

    Times are those of `time.monotonic()`. Any thread may call the methods. They return at once; only
    `start`, `stop` and `close` take up to some tenths of a second.

    Args:
        tell: called with each reading of the counters, on the driver's thread.
    """

    def __init__(self, config: CreateConfig, tell: Callable[[CreateReading], None] | None = None) -> None:
        self.config, self._tell = config, tell
        self._loop: ControlLoop | None = None
        self._link: SerialLink | None = None
        self.watchdog: Watchdog | None = None
        self._thread: threading.Thread | None = None
        self._ending, self._wake, self._polled = (threading.Event() for _ in range(3))

    def start(self) -> None:
        """Opens the port, enters safe mode, clears the counters and starts reading.

        Raises:
            InputError: `NoPort`, `NoAnswer`, `NotSafe` or `WatchdogFailed`.
        """
        if self._link is not None:
            raise ValueError("a driver starts once")
        config, model = self.config, protocol.MODELS[self.config.model]
        self._link = SerialLink(open_port(config.port, model.baud), model)
        try:
            self.watchdog = Watchdog(config.port, model.baud, config.patience, config.replug)
            self._wake_up(self._link)
            self._loop = ControlLoop(config, self._link, time.monotonic, self._tell)
        except BaseException:
            self.close()
            raise
        self._thread = threading.Thread(target=self._run, name="create", daemon=True)
        self._thread.start()

    def drive(self, forward: float, turn: float) -> None:
        """Drives, m/s and rad/s counter-clockwise, for at most `patience`; call it again to continue.

        Raises:
            CommandRefused: a speed is above the limit or not finite, or the driver is not started, or
            stopped and not released.
        """
        self._running_loop().steer(forward, turn)
        self._wake.set()

    def stop(self) -> None:
        """Stops the wheels; returns when the command has been sent."""
        self._running_loop().steer(0.0, 0.0)
        self._next_poll()

    def refresh(self) -> None:
        """Reads the sensors now; returns when the reading has arrived or failed. Commands continue."""
        self._running_loop().counters.due = True
        self._next_poll()

    def release(self) -> None:
        """Allows driving again after a stop and enters safe mode again.

        Raises:
            CommandRefused: a new driver is required.
        """
        self._running_loop().release()
        self._next_poll()

    def odometry(self) -> Odometry:
        """Motion from the last call to the last reading; the turn is not wrapped."""
        return self._running_loop().take_odometry()

    def gap(self) -> bool:
        """Whether readings were lost since the last call, so that motion may be missing."""
        return self._running_loop().gap()

    @property
    def active_stop(self) -> StopEvent | None:
        """The stop in effect until `release`, or None."""
        return self._loop.active_stop if self._loop else None

    @property
    def last_reply(self) -> protocol.SensorReply | None:
        """The last reading."""
        return self._loop.last_reply if self._loop else None

    @property
    def doubt(self) -> str:
        """What speaks against the odometry so far; '' for nothing."""
        return self._loop.counters.doubt if self._loop else ""

    @property
    def counts(self) -> LinkCounts:
        """Counts of queries so far."""
        return self._link.counts if self._link else LinkCounts()

    def close(self) -> None:
        """Stops the wheels, leaves safe mode and closes the port. May be called more than once.

        If the port was disconnected, the watchdog process remains for `replug` s, to stop the robot when the
        port returns.
        """
        self._ending.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        gone = False
        if self._link is not None:
            try:
                self._link.send(protocol.STOP_ANYHOW)
                self._link.send(protocol.START)
            except Unplugged:
                gone = True
            with contextlib.suppress(OSError):
                self._link.close()
        if self.watchdog is not None:
            if gone:
                self.watchdog.leave()
            else:
                self.watchdog.close()
            self.watchdog = None
        self._loop = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _running_loop(self) -> ControlLoop:
        if self._loop is None:
            raise CommandRefused("the driver is not started")
        return self._loop

    def _wake_up(self, link: SerialLink) -> None:
        """Enters safe mode and clears the counters."""
        port = self.config.port
        found, last = None, ""
        try:
            for _ in range(TRIES):
                for command in (protocol.STOP_ANYHOW, protocol.START, protocol.SAFE):
                    link.send(command)
                    time.sleep(PAUSE)
                try:
                    found = link.ask(math.inf)
                    break
                except (NoReply, BadReply) as error:
                    last = str(error)
        except Unplugged as error:
            last = str(error)
        if found is None:
            expected = f"replies of a {self.config.model} at {protocol.MODELS[self.config.model].baud} baud"
            cure = "switch it on, check cable, port and `live.create.model` (create1 or create2)"
            raise NoAnswer(port, f"no valid reply ({last})", expected, cure)
        if found.bumps & Bumps.DROPPED or found.mode != protocol.Mode.SAFE:
            stays = f"the Create stays in {found.mode.name.lower()} mode, {found.bumps.describe()}"
            cure = "set it on all its wheels, away from edges, and unplug its charger"
            raise NotSafe(port, stays, "safe mode", cure)

    def _run(self) -> None:
        loop, guard = self._loop, self.watchdog
        assert loop is not None
        assert guard is not None
        try:
            while not self._ending.is_set():
                due = time.monotonic() + 1 / self.config.rate
                # Before the first command: a program that hangs right after it is guarded too.
                if not guard.beat() and loop.active_stop is None:
                    loop.halt(StopReason.UNGUARDED, "the watchdog process does not respond")
                loop.poll()
                self._polled.set()
                if loop.active_stop and loop.active_stop.reason is StopReason.UNPLUGGED:
                    return
                self._wake.wait(max(0.0, due - time.monotonic()))
                self._wake.clear()
        finally:  # the watchdog then stops the wheels
            loop.halt(StopReason.UNGUARDED, "the control thread has ended")

    def _next_poll(self) -> None:
        """Waits for the end of a poll that starts after this call."""
        thread = self._thread
        for _ in range(2):  # the first may have started earlier
            self._polled.clear()
            self._wake.set()
            while thread and thread.is_alive() and not self._polled.wait(0.05):
                pass
