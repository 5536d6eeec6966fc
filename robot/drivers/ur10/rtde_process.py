"""The RTDE process: it alone loads ur_rtde, which aborts, hangs or crashes on controller faults.

    python -m robot.drivers.ur10.rtde_process FD CONFIG_JSON

FD is the inherited descriptor of the shared memory (shared_state.py). Commands come as JSON lines on the
standard input, reports leave as JSON lines on the standard output; the output of the library goes to the
standard error.

This process stops the arm when a state requires it, when the session requests it, and when the session hangs
or has ended. If this process ends as well, the controller's watchdog times out and stops the arm. A call of
the control interface takes some 20 ms, and never returns when the controller stalls: a command thread calls
it (priority: stop, move, watchdog reset), and the main thread reads and checks states.
"""

from __future__ import annotations

import json
import math
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from robot.drivers.outcome import SessionOutcome
from robot.drivers.processes import LatenessMeter, become_urgent
from robot.drivers.ur10 import dashboard, safety
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import Finding, TargetRefused, check_state
from robot.drivers.ur10.shared_state import ARM_STATE, SharedState
from tactile.base.errors import InputError
from tactile.pokes import PokeConfig, force_rise, is_loaded

MAX_MISSING_STATES = 3  # state periods without a state before an interruption is certain
SCRIPT_UNUSABLE = safety.SAFETY_STOPS | {SessionOutcome.ARM_GONE, SessionOutcome.HOST_LATE}
"""Outcomes after which the control script gets no more commands: its watchdog times out and ends it."""


class ArmCommand(NamedTuple):
    """A command from the session.

    Attributes:
        do: `move`, `poke`, `retreat` or `end`. number: of the command. target: [6] tool pose. speed: m/s, as
            sent to the controller. stops: number of stops requested before; a later stop revokes the command.
            pokes: settings of a poke (`tactile.pokes.PokeConfig`). threshold: of its rise, N.
    """

    do: str
    number: int = 0
    target: tuple[float, ...] = ()
    speed: float = 0.0
    stops: int = 0
    pokes: dict[str, Any] | None = None
    threshold: float = 0.0


class _Poke(NamedTuple):
    """A poke in progress.

    Attributes:
        number: of the command. along: [3] its direction. first: counter of its first state. longest: number
            of its newest states that are looked at. config, threshold: see `ArmCommand`.
    """

    number: int
    along: np.ndarray
    first: int
    longest: int
    config: PokeConfig
    threshold: float


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
        self._poke: _Poke | None = None
        self._watch = safety.NO_STATE
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
        self._watch = 0, self._watch[1]

    def check_state(self, state: np.ndarray) -> None:
        """Stops if a state (ARM_STATE) requires it."""
        self._watch, finding = check_state(self.config, self._watch, state, self._rest, self._force_limit)
        if finding is not None:
            self.hold(finding)
        elif self._poke is not None:
            self._feel(self._poke, state)

    def _feel(self, poke: _Poke, state: np.ndarray) -> None:
        """Stops a poke at a contact, seen from a new state (ARM_STATE): the force rises, along the way or, at
        an edge that the tool grazes, across it."""
        states = self.shared.since(max(poke.first, self.shared.newest - poke.longest) - 1)
        push = -states["force"][:, :3] @ poke.along
        rise = np.hypot(*force_rise(poke.config, states["force"][:, :2].T, self.config.hz)[:, -1])
        if rise > poke.threshold or is_loaded(push, self.config.force_limit)[-1]:
            self._poke = None
            self.stop()
            self.report(say="touched", number=poke.number, tcp=state["tcp"].tolist())

    def hold(self, finding: Finding) -> None:
        """Stops and refuses further moves, unless an earlier finding did. Stops a retreat in any case."""
        self.script_unusable |= finding.outcome in SCRIPT_UNUSABLE
        if self.held is not None and not self._retreating:
            return
        if self.held is None:
            self.held = finding
            self.report(say="fault", outcome=finding.outcome.name, detail=finding.detail)
        self._retreating, self._poke = False, None
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
            target = safety.check_command(self.config, order.target, here["tcp"], order.speed)
            if order.do == "retreat":
                way = math.dist(target[:3], here["tcp"][:3])
                if way > self.config.backoff + 2 * safety.MOVED_ON or order.speed > safety.RETREAT_SPEED:
                    raise TargetRefused(f"a retreat of {way:.3f} m at {order.speed:g} m/s exceeds the limits")
        except TargetRefused as refused:
            self.hold(Finding(SessionOutcome.NOT_ARRIVED, f"the RTDE process refused the target: {refused}"))
            return
        # moveL accepts any target; one without joint solution ends the script on a real controller.
        if not self.control.isPoseWithinSafetyLimits(target.tolist()):
            # False is also the answer during a stop; the next state then shows the stop.
            time.sleep(MAX_MISSING_STATES / self.config.hz)
            if order.do == "poke":  # the session pokes less far
                self.report(say="unreachable", number=order.number)
                return
            places = ", ".join(f"{v:.3f}" for v in target)
            self.hold(Finding(SessionOutcome.UNREACHABLE, f"no joint solution for ({places})"))
            return
        if self._revoked(order):
            return
        if order.do == "retreat":
            force = math.hypot(*(here["force"][:3] - self._rest[:3]))
            self._force_limit = max(force, self.config.force_limit) + self.config.force_limit
            self._watch = 0, self._watch[1]
            self._retreating = True
        newest = self.shared.latest()
        assert newest is not None
        self._poke = None
        if order.do == "poke":
            pokes, way = PokeConfig.model_validate(order.pokes), target[:3] - here["tcp"][:3]
            along = way / max(float(np.linalg.norm(way)), safety.MOVED_ON)
            longest = round(pokes.before[1] * self.config.hz) + 1
            first = self.shared.newest
            self._poke = _Poke(order.number, along, first, longest, pokes, order.threshold)
        self.report(say="moving", number=order.number, operation=int(newest["operation"]))
        self.control.moveL(target.tolist(), order.speed, self.config.acceleration, True)

    def _revoked(self, order: ArmCommand) -> bool:
        stopped = order.stops != int(self.shared.control["stops"]) or self._requested_stops() != self._stopped
        return stopped or (self.held is not None and order.do != "retreat")

    def _requested_stops(self) -> tuple[int, int]:
        return int(self.shared.control["stops"]), self._own_stops


PLAYING = 2  # runtime state
REST_TIME = 0.25  # s of states at rest, over which the force at rest is averaged
LAST_STOP = 0.4  # s, duration of the last stop before the dashboard server is used

VARIABLES = ["timestamp", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force", "actual_q"]
VARIABLES += ["robot_mode", "safety_status_bits", "runtime_state"]


class _RtdeProcess:
    """Reads and checks states, publishes them, and watches the session."""

    def __init__(
        self, config: ArmConfig, shared: SharedState, receive: Any, control: Any, reports: int
    ) -> None:
        self.config, self.shared, self.receive, self.control = config, shared, receive, control
        self.commands = CommandThread(config, shared, control, self.report)
        self._reports = reports
        self._state = np.zeros((), ARM_STATE)
        self._settled = False
        self._leaving = math.inf
        self._input = b""

    def run(self) -> None:
        """Runs until the session has ended."""
        began = time.monotonic()
        threading.Thread(target=self.commands.run, daemon=True).start()
        period, longest = 0.25 / self.config.hz, MAX_MISSING_STATES / self.config.hz
        lateness = LatenessMeter(period, began)
        while True:
            stands = self.commands.leaving and self.commands.stops_sent and safety.at_rest(self._state)
            if stands or time.monotonic() > self._leaving:  # the last stop has timed out
                dashboard.stop_program(self.config.host)
                return
            now = time.monotonic()
            self.shared.control["late"] = lateness.turn(now)
            if self._read(now):
                self.commands.check_state(self._state)
                if self._settled and self._state["runtime"] != PLAYING:
                    unreset, late = self.commands.unreset(now), float(self.shared.control["late"])
                    self.commands.hold(safety.ended_script_finding(self.config, unreset, late))
            elif now - self._state["host"] > longest and not self.receive.isConnected():
                self.commands.hold(Finding(SessionOutcome.ARM_GONE, "the controller closed the connection"))
            if not self._settled and self.shared.newest and now - began > REST_TIME:
                # The median force is that at rest, without contact.
                states = self.shared.since(int(self.shared.control["first"]) - 1)
                self.commands.set_rest_force(np.median(states["force"], axis=0))
                self._settled = True
                self.report(say="ready")
            self._listen()
            silent = now - float(self.shared.control["heartbeat"])
            if silent > self.config.heartbeat and not self.commands.leaving:
                # The thread of the session that sends it does little else.
                detail = f"this machine was {silent:.3f} s late: the session sent no heartbeat for so long"
                self.report(say="fault", outcome=SessionOutcome.HOST_LATE.name, detail=detail)
                self._leave(detail)
            self.commands.check_stop_request()
            time.sleep(period)

    def report(self, **fields: Any) -> None:
        """Sends a report to the session."""
        try:
            os.write(self._reports, json.dumps(fields).encode() + b"\n")
        except OSError:
            self._leave("the session has closed its pipe")

    def _read(self, now: float) -> bool:
        """Reads a state, all fields from one packet; returns whether it is new."""
        receive, state = self.receive, self._state
        stamp = receive.getTimestamp()
        if stamp == state["robot"]:
            return False
        for _ in range(4):
            state["robot"] = stamp
            state["tcp"] = receive.getActualTCPPose()
            state["speed"] = receive.getActualTCPSpeed()
            state["force"] = receive.getActualTCPForce()
            state["joints"] = receive.getActualQ()
            state["mode"] = receive.getRobotMode()
            state["safety"] = receive.getSafetyStatusBits()
            state["runtime"] = receive.getRuntimeState()
            stamp = receive.getTimestamp()
            if stamp == state["robot"]:
                break
        operation = self.control.getAsyncOperationProgressEx()
        state["operation"] = operation.operationId()
        state["progress"] = operation.progress() if operation.isAsyncOperationRunning() else -1
        state["host"] = now
        self.shared.publish(state)
        return True

    def _listen(self) -> None:
        """Reads commands; at the end of the input the session has ended."""
        try:
            data = os.read(0, 65536)
        except BlockingIOError:
            return
        if not data:
            self._leave("the session has ended")
        *lines, self._input = (self._input + data).split(b"\n")
        for line in lines:
            order = ArmCommand(**json.loads(line))
            if order.do == "end":
                self._leave("the session requested the end")
            else:
                self.commands.put(order)

    def _leave(self, reason: str) -> None:
        """Starts the shutdown by requesting a last stop."""
        if math.isinf(self._leaving):
            print(reason, file=sys.stderr, flush=True)
            self._leaving = time.monotonic() + LAST_STOP
            self.commands.leaving = True
            self.commands.stop()


def _connect(config: ArmConfig) -> tuple[Any, Any]:
    """The receive and control interfaces of the library, with tool and watchdog set."""
    try:
        import rtde_control
        import rtde_receive
    except ImportError as error:
        raise InputError("ur_rtde", "not installed", "", "pip install 'ratslam[live]'") from error
    receive = rtde_receive.RTDEReceiveInterface(config.host, config.hz, VARIABLES)
    control = rtde_control.RTDEControlInterface(config.host, config.hz)
    if config.tool is not None and not control.setTcp(list(config.tool)):
        raise RuntimeError("the controller did not accept the tool centre point")
    if not control.setWatchdog(config.watchdog_hz):
        raise RuntimeError("the controller did not accept the watchdog")
    return receive, control


def _main(shared_fd: str, text: str) -> None:
    """Runs the process. It ends without destructors, in which the library aborts after a lost connection."""
    reports = os.dup(1)
    os.dup2(2, 1)
    os.set_blocking(0, False)
    become_urgent()
    config = ArmConfig.model_validate_json(text)
    shared = SharedState(int(shared_fd))
    # The constructors hold the interpreter's lock and may never return; the alarm ends the process.
    signal.alarm(math.ceil(config.connect) + 1)
    try:
        receive, control = _connect(config)
    except Exception as error:
        os.write(reports, json.dumps({"say": "refused", "detail": str(error)}).encode() + b"\n")
        os._exit(1)
    signal.alarm(0)
    _RtdeProcess(config, shared, receive, control, reports).run()
    os._exit(0)


if __name__ == "__main__":
    _main(*sys.argv[1:])
