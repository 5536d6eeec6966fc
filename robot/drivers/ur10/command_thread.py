"""Command thread of the RTDE process. Priority: stop, move, watchdog reset.

A call of the control interface takes some 20 ms, and never returns when the controller stalls. The main
thread of the process (rtde_process.py) therefore reads and checks states.
"""

from __future__ import annotations

import math
import queue
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from robot.drivers.lateness import LatenessMeter
from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import (
    MOVED_ON,
    RETREAT_SPEED,
    Finding,
    StateMemory,
    TargetRefused,
    check_command,
    check_state,
)
from robot.drivers.ur10.shared_state import SharedState

MAX_MISSING_STATES = 3  # state periods without a state before an interruption is certain
SCRIPT_UNUSABLE = {
    SessionOutcome.ARM_GONE,
    SessionOutcome.HOST_LATE,
    SessionOutcome.PROTECTIVE_STOP,
    SessionOutcome.SAFEGUARD_STOP,
    SessionOutcome.EMERGENCY_STOP,
}
"""Outcomes after which the control script gets no more commands: its watchdog times out and ends it."""


class ArmCommand(NamedTuple):
    """A command from the session.

    Attributes:
        do: `move`, `retreat` or `end`. number: of the command. target: [6] tool pose. speed: m/s, as sent to
            the controller. stops: number of stops requested before; a later stop revokes the command.
    """

    do: str
    number: int = 0
    target: tuple[float, ...] = ()
    speed: float = 0.0
    stops: int = 0


class CommandThread:
    """Sends commands to the control interface and decides on stops.

    Attributes:
        held: reason to refuse moves, or None. script_unusable: whether the script gets no more commands.
        leaving: whether the process is about to end.
    """

    def __init__(
        self, config: ArmConfig, shared: SharedState, control: Any, report: Callable[..., None]
    ) -> None:
        self.config, self.shared, self.control, self.report = config, shared, control, report
        self.held: Finding | None = None
        self.script_unusable = False
        self.leaving = False
        self._retreating = False
        self._watch = StateMemory()
        self._rest = np.zeros(6)
        self._force_limit = math.inf  # N; contacts are detected once the force at rest is known
        self._own_stops = 0
        self._stopped = self._requested_stops()
        self._orders: queue.SimpleQueue[ArmCommand] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._reset = time.monotonic()  # the last reset of the watchdog
        self._unreset = LatenessMeter(0.0, self._reset)

    # Called by the thread that reads states.
    def set_rest_force(self, rest: np.ndarray) -> None:
        """Sets the force without contact [6] and starts the detection of contacts."""
        self._rest, self._force_limit = rest, self.config.force_limit
        self._watch = self._watch._replace(loaded=0)

    def check_state(self, state: np.ndarray) -> None:
        """Stops if a state (ARM_STATE) requires it."""
        self._watch, finding = check_state(self.config, self._watch, state, self._rest, self._force_limit)
        if finding is not None:
            self.hold(finding)

    def hold(self, finding: Finding) -> None:
        """Stops and refuses further moves, unless an earlier finding did. Stops a retreat in any case."""
        self.script_unusable |= finding.outcome in SCRIPT_UNUSABLE
        if self.held is not None and not self._retreating:
            return
        if self.held is None:
            self.held = finding
            self.report(say="fault", outcome=finding.outcome.name, detail=finding.detail)
        self._retreating = False
        self.stop()

    def stop(self) -> None:
        """Requests a stop."""
        self._own_stops += 1
        self._wake.set()

    def put(self, order: ArmCommand) -> None:
        self._orders.put(order)
        self._wake.set()

    def check_stop_request(self) -> None:
        """Wakes the thread if the session has requested a stop."""
        if self._requested_stops() != self._stopped:
            self._wake.set()

    @property
    def stops_sent(self) -> bool:
        """Whether every requested stop has been sent."""
        return self.script_unusable or self._requested_stops() == self._stopped

    # Called by the command thread.
    def run(self) -> None:
        """Runs until the process ends."""
        while True:
            self._wake.wait(0.3 / self.config.watchdog_hz)
            self._wake.clear()
            if not self.script_unusable:
                self.act()

    def act(self) -> None:
        """Sends a requested stop, then starts queued moves; resets the watchdog while the session's heartbeat
        is recent."""
        requested = self._requested_stops()
        if requested != self._stopped:
            self.control.stopL(self.config.deceleration, True)
            self._stopped = requested
        while not (self._orders.empty() or self.leaving):
            self.execute(self._orders.get())
        if time.monotonic() - float(self.shared.control["heartbeat"]) <= self.config.heartbeat:
            self.control.kickWatchdog()
            self._reset = time.monotonic()
            self._unreset.turn(self._reset)

    def unreset(self, now: float) -> float:
        """Longest time between two resets of the watchdog within the last second, up to now (s), s."""
        return max(self._unreset.worst(now), now - self._reset)

    def execute(self, order: ArmCommand) -> None:
        """Starts a move after the last checks."""
        here = self.shared.latest()
        if here is None or self._revoked(order):
            return
        try:
            target = check_command(self.config, order.target, here["tcp"], order.speed)
            if order.do == "retreat":
                _check_retreat(self.config, target, here["tcp"], order.speed)
        except TargetRefused as refused:
            self.hold(Finding(SessionOutcome.NOT_ARRIVED, f"the RTDE process refused the target: {refused}"))
            return
        # moveL accepts any target; one without joint solution ends the script on a real controller.
        if not self.control.isPoseWithinSafetyLimits(target.tolist()):
            # False is also the answer during a stop; the next state then shows the stop.
            time.sleep(MAX_MISSING_STATES / self.config.hz)
            places = ", ".join(f"{v:.3f}" for v in target)
            self.hold(Finding(SessionOutcome.UNREACHABLE, f"no joint solution for ({places})"))
            return
        if self._revoked(order):
            return
        if order.do == "retreat":
            force = math.hypot(*(here["force"][:3] - self._rest[:3]))
            self._force_limit = max(force, self.config.force_limit) + self.config.force_limit
            self._watch = self._watch._replace(loaded=0)
            self._retreating = True
        newest = self.shared.latest()
        assert newest is not None
        self.report(say="moving", number=order.number, operation=int(newest["operation"]))
        self.control.moveL(target.tolist(), order.speed, self.config.acceleration, True)

    def _revoked(self, order: ArmCommand) -> bool:
        stopped = order.stops != int(self.shared.control["stops"]) or self._requested_stops() != self._stopped
        return stopped or (self.held is not None and order.do != "retreat")

    def _requested_stops(self) -> tuple[int, int]:
        return int(self.shared.control["stops"]), self._own_stops


def _check_retreat(config: ArmConfig, target: np.ndarray, here: np.ndarray, speed: float) -> None:
    way = math.dist(target[:3], here[:3])
    if way > config.backoff + 2 * MOVED_ON or speed > RETREAT_SPEED:
        raise TargetRefused(f"a retreat of {way:.3f} m at {speed:g} m/s exceeds the limits")
