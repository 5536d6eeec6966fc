"""Arm and head of a live session, polled a hundred times a second, with one clock for both."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Self

import numpy as np

from robot.drivers.clock_sync import ClockSync
from robot.drivers.head.device import open_bridge
from robot.drivers.head.reader import HeadReader
from robot.drivers.head.whisk_control import HeadDriver
from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.arm import Arm
from robot.live.arm_odometry import ArmOdometry
from robot.live.head_stream import HeadStream
from robot.live.live_config import LiveConfig
from robot.live.polling import TICK, OperatorStop, SessionFault, session_fault, wait_until
from robot.live.recorder import LiveRecorder
from tactile.whiskers.head_geometry import HeadConfig, ur10_head

MAX_REST_TIME, REST_TIME = 2.0, 0.3
"""Longest wait for a stopped arm, and required time at rest, s: after a contact it stops, then backs off."""


class Rig:
    """The two devices of a session; a context manager that leaves both at rest.

    Args:
        stopped: whether the operator has requested the end.

    Attributes:
        arm, head, driver: the devices. stream: samples and clock of the head. odometer: of the arm. epoch:
            time 0 of the session on the host's clock, s. state_ages: age of the newest state at each poll, s.
            recorder: recorder of all data, or None.
    """

    def __init__(self, config: LiveConfig, head: HeadConfig, stopped: Callable[[], bool]) -> None:
        self.config, self.shape = config, ur10_head(head)
        whiskers = len(self.shape.length)
        self.arm = Arm(config.arm)
        self.head = HeadReader(
            lambda: open_bridge(config.head.address),
            whiskers,
            config.head,
            alive=self.shape.alive,
            on_overload=self._overload,
        )
        self.driver = HeadDriver(self.head, self.shape)
        self.stream, self.odometer = HeadStream(self.head), ArmOdometry(config)
        self.epoch = time.monotonic()
        self.state_ages: list[float] = []
        self.recorder: LiveRecorder | None = None
        self._stopped = stopped
        self._arm_clock = ClockSync()
        self._seen = 0

    def now(self) -> float:
        """Session time, s."""
        return time.monotonic() - self.epoch

    def poll(self) -> None:
        """Reads the data of both devices.

        Raises:
            SessionFault, OperatorStop: the session must end.
        """
        for frames, arrival in self.stream.take():
            if self.recorder is not None:
                self.recorder.add_frames(frames, arrival - self.epoch)
        self._take_states()
        fault = self.arm.fault or self.stream.fault or (self.recorder and self.recorder.fault)
        if fault:
            raise SessionFault(fault)
        if self._arm_clock.jumps:
            raise session_fault(SessionOutcome.CLOCK_JUMPED, "the controller's clock jumped")
        if self._stopped():
            raise OperatorStop

    def wait_until(self, done: Callable[[], bool], longest: float, late: SessionOutcome, what: str) -> None:
        """Polls until a condition is true; see `robot.live.polling.wait_until`."""
        wait_until(self.poll, done, longest, late, what)

    def begin(self) -> None:
        """Sets time 0 of the session to now."""
        self.epoch = time.monotonic()
        self.state_ages = []

    def rest(self) -> bool:
        """Stops the arm, unless a fault has, and retracts the whiskers; returns whether the arm rests."""
        if self.arm.fault is None:
            self.arm.halt()
        self.driver.rest()
        began = stood = now = time.monotonic()
        while now - stood < REST_TIME and now - began < MAX_REST_TIME:
            time.sleep(TICK)
            now = time.monotonic()
            if not self.arm.still() and self.arm.age() <= self.config.arm.stale:
                stood = now
        return self.arm.still()

    def record_event(self, name: str, text: str) -> None:
        """Records an event."""
        if self.recorder is not None:
            self.recorder.add_event(self.now(), name, text)

    def _take_states(self) -> None:
        states = self.arm.states(self._seen)
        if self.arm.latest() is not None:
            self.state_ages.append(self.arm.age())
        if not len(states):
            return
        self._seen = int(states["counter"][-1])
        for robot, host in zip(states["robot"].tolist(), states["host"].tolist(), strict=True):
            self._arm_clock.observe(robot, host)
        times = np.asarray(self._arm_clock.to_host(states["robot"]))
        self.odometer.add(times, states["tcp"], states["speed"])
        if self.recorder is not None:
            states["host"] -= self.epoch
            self.recorder.add_states(states)

    def _overload(self, whisker: int) -> None:
        self.arm.fail(SessionOutcome.CONTACT, f"whisker {whisker} is bent beyond the overload limit")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is KeyboardInterrupt:  # second interrupt: stop by the dashboard server at once
            dashboard.stop_program(self.config.arm.host)
        self.arm.close()
        self.head.close()
