"""A Create and its whiskers in a live session, polled a hundred times a second."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Self

import numpy as np

from robot.drivers.create.driver import CreateDriver
from robot.drivers.create.protocol import Bumps
from robot.drivers.create.stop_reasons import StopReason
from robot.drivers.head.device import open_bridge
from robot.drivers.head.reader import HeadReader
from robot.drivers.outcome import SessionOutcome
from robot.live.config import LiveConfig
from robot.live.head_stream import HeadStream
from robot.live.polling import OperatorStop, SessionFault, session_fault, wait_until
from robot.live.recorder import LiveRecorder
from robot.live.strain_monitor import StrainMonitor
from robot.simulation.create.strain_sensors import fixed_whiskers
from tactile.base.types import Odometry

OUTCOMES = {
    StopReason.WHEEL_DROP: SessionOutcome.WHEEL_DROP,
    StopReason.LEFT_SAFE_MODE: SessionOutcome.LEFT_SAFE_MODE,
    StopReason.SILENT: SessionOutcome.ROBOT_SILENT,
    StopReason.GARBLED: SessionOutcome.ROBOT_GARBLED,
    StopReason.UNPLUGGED: SessionOutcome.LINK_LOST,
    StopReason.UNGUARDED: SessionOutcome.WATCHDOG_GONE,
}
"""Outcome of a session by the reason for a stop. A contact of the bumper ends only the motion."""
REST_TIME = 0.15
"""Time for which a robot at rest must not move, s."""
MAX_READ_TIME = 1.0
"""Longest wait for a reading, s: the robot has another fault before."""


class CreateRig:
    """The robot and the whiskers of a session; a context manager that leaves the robot at rest.

    Args:
        config: with a part `create`. stopped: whether the operator has requested the end.

    Attributes:
        create: settings of the robot. robot, head: the devices. stream: samples and clock of the whiskers.
        monitor: their strain. alive: [W] bool, whiskers with a signal. epoch: time 0 of the session on the
            host's clock, s. recorder: recorder of all data, or None.
    """

    def __init__(self, config: LiveConfig, stopped: Callable[[], bool]) -> None:
        assert config.create is not None
        self.config, self.create = config, config.create
        plan = self.create.plan
        fan = fixed_whiskers(plan.whiskers)
        self.alive = fan.alive.copy()
        self.robot = CreateDriver(self.create)
        self.head = HeadReader(lambda: open_bridge(config.head.address), len(fan.base), config.head)
        self.stream = HeadStream(self.head)
        self.monitor = StrainMonitor(
            plan.whiskers.rate, plan.behaviour.period, self.create.strain_per_radian, len(fan.base)
        )
        self.epoch = time.monotonic()
        self.recorder: LiveRecorder | None = None
        self._stopped = stopped
        self._connections = 0  # of the whiskers, seen so far
        self._free = self.epoch  # newest time at which the bumper was not pressed

    def now(self) -> float:
        """Session time, s."""
        return time.monotonic() - self.epoch

    def poll(self) -> None:
        """Reads the samples of the whiskers and the state of the robot.

        Raises:
            SessionFault, OperatorStop: the session must end.
        """
        for frames, arrival in self.stream.take():
            if self.stream.restarts != self._connections:
                self._connections = self.stream.restarts
                self.monitor.restart()
            if self.recorder is not None:
                self.recorder.add_frames(frames, arrival - self.epoch)
            self.monitor.add(frames)
        fault = self.stream.fault or (self.recorder and self.recorder.fault)
        stop = self.robot.active_stop
        if stop is not None and stop.reason in OUTCOMES:
            raise session_fault(OUTCOMES[stop.reason], stop.detail + self._outlook(stop.reason))
        if fault:
            raise SessionFault(fault)
        reply, now = self.robot.last_reply, time.monotonic()
        if reply is None or not reply.bumps & Bumps.BUMPED:
            self._free = now
        elif now - self._free > self.create.stuck:
            detail = f"pressed for {now - self._free:.1f} s, although the robot has backed off"
            raise session_fault(SessionOutcome.BUMPER_STUCK, detail)
        if self._stopped():
            raise OperatorStop

    def wait_until(self, done: Callable[[], bool], longest: float, late: SessionOutcome, what: str) -> None:
        """Polls until a condition is true; see `robot.live.polling.wait_until`."""
        wait_until(self.poll, done, longest, late, what)

    def begin(self) -> None:
        """Sets time 0 of the session to now."""
        self.robot.refresh()
        self.robot.odometry()
        self.robot.gap()
        self.epoch = self._free = time.monotonic()

    @property
    def bumped(self) -> bool:
        """Whether a contact of the bumper has stopped the robot."""
        stop = self.robot.active_stop
        return stop is not None and stop.reason is StopReason.BUMPED

    def motion(self) -> Odometry:
        """The motion up to a new reading since the last call, by the wheels."""

        motion = self.robot.odometry()

        def read() -> bool:
            nonlocal motion
            self.robot.refresh()
            motion = self.robot.odometry()
            return motion.dt > 0

        if motion.dt <= 0:
            self.wait_until(read, MAX_READ_TIME, SessionOutcome.ROBOT_SILENT, "a reading")
        if self.robot.gap():
            self.record_event("discontinuity", "a reply of the robot was lost, perhaps with its motion")
        return motion

    def rest(self) -> bool:
        """Stops the robot; returns whether it replies and rests."""
        if self.robot.last_reply is None:
            return False
        self.robot.stop()
        self.robot.refresh()
        self.robot.odometry()
        good = self.robot.counts.good
        time.sleep(REST_TIME)
        self.robot.refresh()
        motion = self.robot.odometry()
        return self.robot.counts.good > good and not any(motion[:3])

    def record_event(self, name: str, text: str) -> None:
        """Records an event."""
        if self.recorder is not None:
            self.recorder.add_event(self.now(), name, text)

    def _outlook(self, reason: StopReason) -> str:
        if reason is not StopReason.UNPLUGGED:
            return ""
        return f"; a watchdog process waits {self.create.replug:g} s for {self.create.port} to return"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.robot.close()
        self.head.close()


def unusual_strain(rows: np.ndarray, contact: float) -> int | None:
    """The first whisker that shakes at rest so much that it would report contacts, or None.

    Args:
        rows: [T, W, 2] monitored strain at rest. contact: strain of a contact.
    """
    swing = np.abs(rows[..., 0] - rows[..., 0].mean(axis=0)).max(axis=0)
    return int(swing.argmax()) if swing.max() > contact / 2 else None
