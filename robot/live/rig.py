"""Arm and head of a live session, polled a hundred times a second, with one clock for both."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable
from typing import Self

import numpy as np

from robot.drivers.clock_sync import ClockSync
from robot.drivers.head.decoder import Frames
from robot.drivers.head.device import open_bridge
from robot.drivers.head.protocol import FrameFlag
from robot.drivers.head.reader import HeadReader, LinkState
from robot.drivers.head.whisk_control import HeadDriver
from robot.drivers.outcome import Fault, SessionOutcome
from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.arm import Arm
from robot.live.arm_odometry import ArmOdometry
from robot.live.config import LiveConfig
from robot.live.recorder import LiveRecorder
from tactile.whiskers.head_geometry import HeadConfig, ur10_head

TICK = 0.01
"""Period of the poll, s."""
MAX_REST_TIME, REST_TIME = 2.0, 0.3
"""Longest wait for a stopped arm, and required time at rest, s: after a contact it stops, then backs off."""

MAX_CLOCK_STEP = 2e-3
"""Largest step of the head's clock against its sample count, s."""


class SessionFault(Exception):
    """A fault ends the session."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(str(fault))
        self.fault = fault


class OperatorStop(Exception):
    """The operator ends the session."""


class Rig:
    """The two devices of a session; a context manager that leaves both at rest.

    Args:
        stopped: whether the operator has requested the end.

    Attributes:
        arm, head, driver: the devices. clock: of the head. odometer: of the arm. epoch: time 0 of the session
            on the host's clock, s. state_ages: age of the newest state at each poll, s. whisk_starts:
            sequence numbers of the first frames of whisks. restarts: number of connections of the head.
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
        self.clock, self.odometer = ClockSync(), ArmOdometry(config)
        self.epoch = time.monotonic()
        self.state_ages: list[float] = []
        self.whisk_starts: list[int] = []
        self.restarts = 0
        self.recorder: LiveRecorder | None = None
        self._stopped = stopped
        self._arm_clock = ClockSync()
        self._seen = 0
        self._ahead: float | None = None  # s by which the head's clock leads its sample count
        self._uneven = 0.0
        self._blocks: queue.SimpleQueue[tuple[Frames, float] | None] = queue.SimpleQueue()
        self.head.on_restart.append(lambda device, host: self._blocks.put(None))
        self.head.listeners.append(lambda frames, arrival: self._blocks.put((frames, arrival)))

    def now(self) -> float:
        """Session time, s."""
        return time.monotonic() - self.epoch

    def poll(self) -> None:
        """Reads the data of both devices.

        Raises:
            SessionFault, OperatorStop: the session must end.
        """
        self._take_frames()
        self._take_states()
        fault = self.arm.fault or self.head.fault or (self.recorder and self.recorder.fault)
        if fault:
            raise SessionFault(fault)
        for jumped, whose in ((self.clock.jumps, "head"), (self._arm_clock.jumps, "controller")):
            if jumped:
                raise SessionFault(
                    Fault(SessionOutcome.CLOCK_JUMPED, f"the {whose}'s clock jumped", time.monotonic())
                )
        if self._uneven > MAX_CLOCK_STEP:
            detail = f"the head's clock is {self._uneven * 1e3:.1f} ms off its sample count"
            raise SessionFault(Fault(SessionOutcome.CLOCK_JUMPED, detail, time.monotonic()))
        if self._stopped():
            raise OperatorStop

    def wait_until(self, done: Callable[[], bool], longest: float, late: SessionOutcome, what: str) -> None:
        """Polls until a condition is true.

        Args:
            longest: time limit, s. late: outcome after that time. what: the awaited event, for the fault.

        Raises:
            SessionFault, OperatorStop.
        """
        due = time.monotonic() + longest
        while not done():
            if time.monotonic() > due:
                raise SessionFault(Fault(late, f"{what} took more than {longest:g} s", time.monotonic()))
            self.poll()
            time.sleep(TICK)

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

    @property
    def streaming(self) -> bool:
        """Whether the head sends samples."""
        return self.head.state.link is LinkState.STREAMING

    def _take_frames(self) -> None:
        while not self._blocks.empty():
            block = self._blocks.get()
            if block is None:  # the head was reconnected: its clock may have changed
                self.clock, self.whisk_starts = ClockSync(), []
                self.restarts += 1
                self._ahead = None
                continue
            frames, arrival = block
            self.clock.observe(float(frames.time.max()) * 1e-6, arrival)
            self._count(frames)
            begins = (frames.flags & np.uint8(FrameFlag.CYCLE)) > 0
            self.whisk_starts += frames.sequence[begins].tolist()
            if self.recorder is not None:
                self.recorder.add_frames(frames, arrival - self.epoch)

    def _count(self, frames: Frames) -> None:
        """Checks the head's clock against its sample count; both are independent of the host's load."""
        assert self.head.identity is not None
        ahead = frames.time * 1e-6 - frames.sequence / self.head.identity.rate
        before = ahead[0] if self._ahead is None else self._ahead
        self._uneven = max(self._uneven, float(np.abs(ahead - before).max()))
        self._ahead = float(ahead[-1])

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
