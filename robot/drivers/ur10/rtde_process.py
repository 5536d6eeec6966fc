"""The RTDE process: it alone loads ur_rtde, which aborts, hangs or crashes on controller faults.

    python -m robot.drivers.ur10.rtde_process FD CONFIG_JSON

FD is the inherited descriptor of the shared memory (shared_state.py). Commands come as JSON lines on the
standard input, reports leave as JSON lines on the standard output; the output of the library goes to the
standard error.

This process stops the arm when a state requires it, when the session requests it, and when the session hangs
or has ended. If this process ends as well, the controller's watchdog times out and stops the arm.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
import time
from typing import Any

import numpy as np

from robot.drivers.lateness import LatenessMeter
from robot.drivers.outcome import SessionOutcome
from robot.drivers.process_priority import become_urgent
from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.command_thread import MAX_MISSING_STATES, ArmCommand, CommandThread
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.late_findings import ended_script_finding, silent_session_finding
from robot.drivers.ur10.safety import Finding, at_rest
from robot.drivers.ur10.shared_state import ARM_STATE, SharedState
from tactile.base.errors import InputError

PLAYING = 2  # runtime state
REST_TIME = (
    0.25  # s of states at rest over which the force at rest is averaged and the session measures the rate
)
LAST_STOP = 0.4  # s, duration of the last stop before the dashboard server is used

VARIABLES = [
    "timestamp",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "actual_q",
    "robot_mode",
    "safety_status_bits",
    "runtime_state",
]


class RtdeProcess:
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
        period = 0.25 / self.config.hz
        lateness = LatenessMeter(period, began)
        while not self._finished():
            now = time.monotonic()
            self.shared.control["late"] = lateness.turn(now)
            if self._read(now):
                self.commands.check_state(self._state)
                if self._settled and self._state["runtime"] != PLAYING:
                    self._lose_script(now)
            elif (
                now - self._state["host"] > MAX_MISSING_STATES / self.config.hz
                and not self.receive.isConnected()
            ):
                self.commands.hold(Finding(SessionOutcome.ARM_GONE, "the controller closed the connection"))
            if not self._settled and self.shared.newest and now - began > REST_TIME:
                self._settle()
            self._listen()
            silent = now - float(self.shared.control["heartbeat"])
            if silent > self.config.heartbeat:
                self._leave_silent_session(silent)
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

    def _settle(self) -> None:
        """Takes the median force as the force at rest and reports that the arm is ready."""
        states = self.shared.since(int(self.shared.control["first"]) - 1)
        self.commands.set_rest_force(np.median(states["force"], axis=0))
        self._settled = True
        self.report(say="ready")

    def _lose_script(self, now: float) -> None:
        unreset, late = self.commands.unreset(now), float(self.shared.control["late"])
        self.commands.hold(ended_script_finding(self.config, unreset, late))

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

    def _leave_silent_session(self, silent: float) -> None:
        """Starts the shutdown because the session sent no heartbeat for some time, s."""
        if not self.commands.leaving:
            finding = silent_session_finding(silent)
            self.report(say="fault", outcome=finding.outcome.name, detail=finding.detail)
            self._leave(finding.detail)

    def _leave(self, reason: str) -> None:
        """Starts the shutdown by requesting a last stop."""
        if math.isinf(self._leaving):
            print(reason, file=sys.stderr, flush=True)
            self._leaving = time.monotonic() + LAST_STOP
            self.commands.leaving = True
            self.commands.stop()

    def _finished(self) -> bool:
        """Whether the arm is at rest or the last stop has timed out; also ends the controller's program."""
        stands = self.commands.leaving and self.commands.stops_sent and at_rest(self._state)
        if stands or time.monotonic() > self._leaving:
            dashboard.stop_program(self.config.host)
            return True
        return False


def connect(config: ArmConfig) -> tuple[Any, Any]:
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


def main(shared_fd: str, text: str) -> None:
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
        receive, control = connect(config)
    except Exception as error:
        os.write(reports, json.dumps({"say": "refused", "detail": str(error)}).encode() + b"\n")
        os._exit(1)
    signal.alarm(0)
    RtdeProcess(config, shared, receive, control, reports).run()
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
