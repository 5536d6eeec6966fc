"""Driver of a Create: a control thread, and a watchdog process for the end of that thread."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from typing import Self

from robot.drivers.create import protocol
from robot.drivers.create.control_loop import PAUSE, ControlLoop
from robot.drivers.create.driver_config import CreateConfig
from robot.drivers.create.serial_link import BadReply, LinkCounts, NoReply, SerialLink, Unplugged, open_port
from robot.drivers.create.stop_reasons import CommandRefused, StopEvent, StopReason
from robot.drivers.create.watchdog import Watchdog
from tactile.base.errors import InputError
from tactile.base.types import Odometry

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
    """

    def __init__(self, config: CreateConfig) -> None:
        self.config = config
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
        self._link = SerialLink(open_port(self.config.port))
        try:
            self.watchdog = Watchdog(self.config.port, self.config.patience, self.config.replug)
            self._wake_up(self._link)
            self._loop = ControlLoop(self.config, self._link, time.monotonic)
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
        self._running_loop()
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
            raise NoAnswer(
                port,
                f"no valid reply ({last})",
                f"replies of a Create at {protocol.BAUD} baud",
                "switch it on, check cable and port; a Create 2 is not supported",
            )
        if found.bumps & protocol.Bumps.DROPPED or found.mode != protocol.Mode.SAFE:
            raise NotSafe(
                port,
                f"the Create stays in {found.mode.name.lower()} mode, {protocol.describe_bumps(found.bumps)}",
                "safe mode",
                "set it on all its wheels, away from edges, and unplug its charger",
            )

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
