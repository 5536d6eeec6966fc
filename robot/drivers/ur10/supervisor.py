"""Supervisor thread of a session: watches the RTDE process, which it starts, and its states.

It repeats stops until the arm is at rest, and keeps the first reason to stop as the fault.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from robot.drivers.outcome import Fault, SessionOutcome
from robot.drivers.processes import LatenessMeter, withheld_signals
from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import (
    RETREAT_SPEED,
    Finding,
    Move,
    StartupRefused,
    at_rest,
    at_target,
    retreat_target,
    stale_finding,
)
from robot.drivers.ur10.shared_state import SharedState

CONNECTION_LOST = ("closed the connection", "Connection reset", "Connection refused", "End of file")


class ArmProcess:
    """A running `robot.drivers.ur10.rtde_process`. The pipes close at any end of this process; the
    subprocess then stops the arm and ends.

    Args:
        shared: file descriptor of the shared memory."""

    def __init__(self, shared: int, config: ArmConfig) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        paths = [str(Path(__file__).parents[3]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(paths),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        module = "robot.drivers.ur10.rtde_process"
        with withheld_signals():
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, str(shared), config.model_dump_json()],
                pass_fds=[shared],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                bufsize=0,
                env=environment,
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._orders, self._reports = self._process.stdin, self._process.stdout
        os.set_blocking(self._orders.fileno(), False)
        os.set_blocking(self._reports.fileno(), False)
        self._rest = b""

    @property
    def pid(self) -> int:
        return self._process.pid

    def send(self, **fields: Any) -> None:
        """Sends a command; without effect after the end of the process, which `exit_finding` reports."""
        with contextlib.suppress(OSError, ValueError):  # ValueError: the pipe is closed
            self._orders.write(json.dumps(fields).encode() + b"\n")

    def reports(self) -> list[dict[str, Any]]:
        """Reports since the last call."""
        data = self._reports.read(65536) or b""
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines]

    def exit_finding(self) -> Finding | None:
        """Reason for the end of the process; None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        said = self.stderr_tail()
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        lines = [line for line in said.splitlines() if "what():" in line] or said.splitlines() or [""]
        last = lines[-1].replace("what():", "").strip()[-200:]
        detail = f"the RTDE process ended ({name})" + (f": {last}" if last else "")
        if code == -signal.SIGABRT and not any(word in said for word in CONNECTION_LOST):
            return Finding(SessionOutcome.ARM_MALFORMED, detail)
        return Finding(SessionOutcome.ARM_GONE, detail)

    def stderr_tail(self) -> str:
        """The last 4 kB of output of the process and the library."""
        # pread: the writing process shares the file position
        size = os.fstat(self._errors.fileno()).st_size
        return os.pread(self._errors.fileno(), 4096, max(0, size - 4096)).decode(errors="replace")

    def end(self, patience: float) -> bool:
        """Asks the process to stop the arm and end; False if it has not ended within `patience` s."""
        self.send(do="end")
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            return False
        return True

    def kill(self) -> None:
        """Kills the process."""
        self._process.kill()
        self._process.wait()
        for file in (self._orders, self._reports, self._errors):
            with contextlib.suppress(OSError):
                file.close()


TICK = 0.005  # s
DASHBOARD_DELAY = 0.3  # s, duration of a stop before the dashboard server is used
ELSEWHERE_TIME = 0.5  # s at rest away from the target after which a move counts as not arrived
HISTORY = 5.0  # s, time span of states in a fault report
PROCESS_LOST = {
    SessionOutcome.ARM_STALE,
    SessionOutcome.ARM_MALFORMED,
    SessionOutcome.ARM_GONE,
    SessionOutcome.CLOCK_JUMPED,
    SessionOutcome.HOST_LATE,
}
"""Outcomes after which the RTDE process may not react: it is killed."""
PendingMove = tuple[int, Move, float]
"""A move in progress: number of the command, the move as planned, and its deadline, s, host's clock."""
SAFETY_STOPS = {SessionOutcome.PROTECTIVE_STOP, SessionOutcome.SAFEGUARD_STOP, SessionOutcome.EMERGENCY_STOP}
"""Outcomes after which a controller may resume its program: the program is ended."""


class Supervisor:
    """State of the RTDE process, and the thread that updates it.

    Attributes:
        fault: the first reason to stop. ready: whether the process has measured the force at rest. refused:
            the failed connection, or None. armed: whether findings become faults. lock: for a check with a
            subsequent command.
    """

    def __init__(self, config: ArmConfig, shared: SharedState) -> None:
        self.config, self.shared = config, shared
        self.lock = threading.RLock()
        self.process: ArmProcess | None = None
        self.pending: PendingMove | None = None
        self.refused: StartupRefused | None = None
        self.fault: Fault | None = None
        self.ready = self.armed = False
        self._started = (0, 0)  # number of a move; newest operation before it
        self._done = 0
        self._number = 0
        self._elsewhere: float | None = None
        self._stop_by: float | None = None
        self._retreat_pending = False
        self._late = 0.0
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="arm", daemon=True)

    def watch(self, process: ArmProcess) -> None:
        """Clears all findings and watches a new process."""
        with self.lock:
            self.fault, self.refused, self.pending, self._stop_by = None, None, None, None
            self.ready = self._retreat_pending = False
            self.process = process
        if not self._thread.is_alive():
            self._thread.start()

    def arm(self) -> None:
        """Lets findings become faults from now on.

        Raises:
            StartupRefused: there is an earlier finding."""
        with self.lock:
            if self.process is not None:
                self.read_reports(self.process)
            if self.refused is not None:
                raise self.refused
            self.armed = True

    def kill_process(self) -> None:
        """Kills the process."""
        with self.lock:
            self.armed = False
            if self.process is not None:
                self.process.kill()
                self.process = None

    def close(self) -> None:
        """Ends the thread."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()

    def send(self, move: Move) -> None:
        """Sends a move command. The caller holds the lock."""
        deadline = time.monotonic() + move.most + self.config.patience
        self._elsewhere = None
        self.pending = self._order("move", move.target, move.speed), move, deadline

    def halt(self) -> None:
        """Revokes all commands and stops, by the dashboard server if the arm does not stop in time."""
        with self.lock:
            self.pending = None
            self.shared.control["stops"] += 1
            self._stop_by = time.monotonic() + DASHBOARD_DELAY

    def fail(self, finding: Finding) -> None:
        """Makes a finding the fault, if it is the first, and stops the arm."""
        with self.lock:
            if self.fault is not None:
                return
            self.fault = Fault(finding.outcome, finding.detail, time.monotonic())
            self.halt()
            if finding.outcome in PROCESS_LOST:
                self.kill_process()
                # Without the process no state shows the standstill; the controller's watchdog times out too.
                self._stop_by = None
                self._stop_by_dashboard()
            elif finding.outcome in SAFETY_STOPS:
                self._stop_by_dashboard()
            self._retreat_pending = finding.outcome is SessionOutcome.CONTACT

    def still(self) -> bool:
        """Whether the newest state is recent and shows an arm at rest."""
        state = self.shared.latest()
        return state is not None and self.age() <= self.config.stale and at_rest(state)

    def age(self) -> float:
        """Age of the newest state, s; infinite before the first."""
        state = self.shared.latest()
        return float("inf") if state is None else time.monotonic() - float(state["host"])

    def arrived(self, pending: PendingMove) -> bool:
        """Whether a move has started and ended and the arm is at its target."""
        return self._ended(pending) and self._deviation(pending) is None

    @property
    def late(self) -> float:
        """Lateness of this thread or of the RTDE process within the last second, s."""
        return max(self._late, float(self.shared.control["late"]))

    def _run(self) -> None:
        lateness = LatenessMeter(TICK, time.monotonic())
        while not self._closing.wait(TICK):
            now = time.monotonic()
            self.shared.control["heartbeat"] = now
            self._late = lateness.turn(now)
            with self.lock:
                if self.process is not None:
                    self.read_reports(self.process)
                if self.process is not None and self.armed and self.fault is None:
                    finding = self.process.exit_finding() or self._check_lateness(now)
                    if finding is not None:
                        self.fail(finding)
                self._follow_up(now)

    def read_reports(self, process: ArmProcess) -> None:
        """Reads the reports of the process."""
        for report in process.reports():
            if report["say"] == "ready":
                self.ready = True
            elif report["say"] == "refused":
                refusal, cure = report["detail"], ""  # an error message of the library
                if "in use" in refusal:
                    others = "disable EtherNet/IP, PROFINET and MODBUS on the controller"
                    refusal, cure = "registers in use", f"end the other RTDE program, or {others}"
                self.refused = StartupRefused(refusal, "", cure)
            elif report["say"] == "moving":
                self._started = report["number"], report["operation"]
            elif report["say"] == "fault":
                outcome, detail = SessionOutcome[report["outcome"]], report["detail"]
                if self.armed:
                    self.fail(Finding(outcome, detail))
                else:
                    self.refused = StartupRefused(detail, "", outcome.value)

    def _check_lateness(self, now: float) -> Finding | None:
        """A finding if states are late, or the arm has not arrived in time."""
        age, pending = self.age(), self.pending
        if age > self.config.stale:
            return stale_finding(age, self.late, self.config.stale)
        if pending is None or pending[0] == self._done:
            return None
        number, move, deadline = pending
        off = self._deviation(pending)
        if off is None and self._ended(pending):
            self._done = number
        elif off is not None and now > deadline:
            return Finding(SessionOutcome.NOT_ARRIVED, f"late (planned: {move.seconds:.0f} s), {off}")
        elif off is not None and self._ended(pending):
            self._elsewhere = self._elsewhere or now
            if now - self._elsewhere > ELSEWHERE_TIME:
                return Finding(SessionOutcome.NOT_ARRIVED, off)
        return None

    def _ended(self, pending: PendingMove) -> bool:
        """Whether the operation of a move has started and ended and the arm is at rest."""
        state = self.shared.latest()
        number, before = self._started
        if state is None or number != pending[0] or int(state["operation"]) == before:
            return False
        return int(state["progress"]) < 0 and self.still()

    def _deviation(self, pending: PendingMove) -> str | None:
        """Distance of the arm from its target, in words; None at the target."""
        state, target = self.shared.latest(), pending[1].target
        if state is None or at_target(self.config, state["tcp"], target):
            return None
        way = float(np.linalg.norm(state["tcp"][:3] - target[:3]))
        return f"{way * 1e3:.1f} mm from its target"

    def _follow_up(self, now: float) -> None:
        """Repeats a stop without effect by the dashboard server; starts the retreat after a contact."""
        if self._stop_by is None:
            return
        if self.still():
            self._stop_by = None
            if self._retreat_pending:
                self._retreat_pending = False
                target = retreat_target(self.config, self.history())
                if target is not None:
                    self._order("retreat", target, RETREAT_SPEED)
        elif now >= self._stop_by:
            self._stop_by_dashboard()
            self._stop_by = now + 2 * DASHBOARD_DELAY

    def history(self) -> np.ndarray:
        """States [N] (ARM_STATE) of the last 5 s."""
        return self.shared.since(max(0, self.shared.newest - int(HISTORY * self.config.hz)))

    def _stop_by_dashboard(self) -> None:
        """Stops by the dashboard server, in a separate thread, so that the heartbeat never blocks."""
        threading.Thread(target=dashboard.stop_program, args=(self.config.host,), daemon=True).start()

    def _order(self, do: str, target: np.ndarray, speed: float) -> int:
        """Sends a command that the next stop revokes; returns its number."""
        self._number += 1
        stops = int(self.shared.control["stops"])
        if self.process is not None:
            self.process.send(
                do=do, number=self._number, target=target.tolist(), speed=float(speed), stops=stops
            )
        return self._number
