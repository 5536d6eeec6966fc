"""Interface of the arm for a session: start after checks, move, halt, faults; and its supervision.

    with Arm(ArmConfig(host="192.168.1.10")) as arm:
        arm.start()                       # StartupRefused: a check failed, nothing has moved
        arm.move(tcp_of(config.placing, pose))
        while not arm.arrived() and arm.fault is None: ...

A thread supervises the arm. The first reason to stop becomes `fault`; after it every move is refused. If the
arm does not stop in time, the dashboard server stops it.
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
from robot.drivers.ur10 import dashboard, safety
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import Finding, Move, StartupRefused, TargetRefused
from robot.drivers.ur10.shared_state import SharedState
from tactile.pokes import PokeConfig

__all__ = ["Arm", "StartupRefused", "TargetRefused"]

CONNECTION_LOST = ("closed the connection", "Connection reset", "Connection refused", "End of file")


class _ArmProcess:
    """A running `robot.drivers.ur10.rtde_process`. The pipes close at any end of this process; the
    subprocess then stops the arm and ends."""

    def __init__(self, shared: int, config: ArmConfig) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        paths = [str(Path(__file__).parents[3]), *filter(None, [os.environ.get("PYTHONPATH")])]
        env = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
        env |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        module, pipe = "robot.drivers.ur10.rtde_process", subprocess.PIPE
        command = [sys.executable, "-m", module, str(shared), config.model_dump_json()]
        with withheld_signals():
            self._process = subprocess.Popen(
                command, pass_fds=[shared], stdin=pipe, stdout=pipe, stderr=self._errors, bufsize=0, env=env
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
        # The last 4 kB of output of the process and the library; pread: the writer shares the file position.
        size = os.fstat(self._errors.fileno()).st_size
        said = os.pread(self._errors.fileno(), 4096, max(0, size - 4096)).decode(errors="replace")
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        lines = [line for line in said.splitlines() if "what():" in line] or said.splitlines() or [""]
        last = lines[-1].replace("what():", "").strip()[-200:]
        detail = f"the RTDE process ended ({name})" + (f": {last}" if last else "")
        if code == -signal.SIGABRT and not any(word in said for word in CONNECTION_LOST):
            return Finding(SessionOutcome.ARM_MALFORMED, detail)
        return Finding(SessionOutcome.ARM_GONE, detail)

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


class Arm(contextlib.AbstractContextManager["Arm"]):
    """One arm. One thread calls its methods; a supervising thread updates its state.

    Attributes:
        fault: the first reason to stop, or None. process: the RTDE process, or None. ready: whether it has
            measured the force at rest. refused: the failed connection, or None. pending: the last move.
            touched: [6] tool pose at which the last poke met something, or None. too_far: whether the arm
            cannot reach its end. armed: whether findings become faults. lock: for a check with a subsequent
            command.
    """

    def __init__(self, config: ArmConfig) -> None:
        self.config, self.shared = config, SharedState()
        self.lock = threading.RLock()
        self.process: _ArmProcess | None = None
        self.pending: PendingMove | None = None
        self.refused: StartupRefused | None = None
        self.touched: np.ndarray | None = None
        self.too_far = False
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

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Checks the controller, starts the RTDE process and checks its first states.

        Raises:
            StartupRefused: a check failed; nothing has moved."""
        safety.check_controller(self.config)
        first = self.shared.newest + 1
        self.shared.control["first"] = first
        self.shared.control["heartbeat"] = time.monotonic()
        process = _ArmProcess(self.shared.fd, self.config)
        with self.lock:  # clears all findings
            self.fault, self.refused, self.pending, self._stop_by = None, None, None, None
            self.ready = self._retreat_pending = False
            self.process = process
        if not self._thread.is_alive():
            self._thread.start()
        try:
            self._await_ready(process)
            safety.check_states(self.config, lambda: self.states(first - 1))
            with self.lock:
                if self.process is not None:
                    self._read_reports(self.process)
                if self.refused is not None:  # an earlier finding
                    raise self.refused
                self.armed = True
        except BaseException:
            self._kill_process()
            raise

    def close(self) -> None:
        """Stops the arm, ends its process and releases threads and shared memory."""
        self.armed = False
        if self.process is not None and not self.process.end(1.0):
            self._kill_process()
            dashboard.stop_program(self.config.host)
        self._kill_process()
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()
        self.shared.close()

    def states(self, after: int = 0) -> np.ndarray:
        """States [N] (ARM_STATE) in the ring buffer with counters above `after`, oldest first."""
        return self.shared.since(after)

    def latest(self) -> np.ndarray | None:
        """The newest state (ARM_STATE, one); None before the first."""
        return self.shared.latest()

    @property
    def history(self) -> np.ndarray:
        """States [N] (ARM_STATE) of the last 5 s."""
        return self.shared.since(max(0, self.shared.newest - int(HISTORY * self.config.hz)))

    def age(self) -> float:
        """Age of the newest state, s; infinite before the first."""
        state = self.shared.latest()
        return float("inf") if state is None else time.monotonic() - float(state["host"])

    def still(self) -> bool:
        """Whether the newest state is recent and shows an arm at rest."""
        state = self.shared.latest()
        return state is not None and self.age() <= self.config.stale and safety.at_rest(state)

    def move(self, tcp: Any, speed: float | None = None) -> Move:
        """Starts a straight move of the tool to a pose [6] and returns at once. It replaces the present move.

        Raises:
            TargetRefused: the target is invalid, or the arm is not armed or has a fault.
        """
        return self._start("move", tcp, speed)

    def poke(self, tcp: Any, pokes: PokeConfig, threshold: float) -> Move:
        """Starts a move of a resting tool that ends at a contact (`touched`), or at the pose [6] (`arrived`).

        Args:
            pokes: speed and windows. threshold: rise of the force that counts as a contact, N.

        Raises:
            TargetRefused: as `move`.
        """
        slow = min(pokes.speed, self.config.speed)
        return self._start("poke", tcp, slow, pokes=pokes.model_dump(), threshold=threshold)

    def _start(self, do: str, tcp: Any, speed: float | None, **more: Any) -> Move:
        with self.lock:  # a fault between check and command would not revoke it
            state = self.latest()
            if self.fault is not None or not self.armed or state is None:
                raise TargetRefused(f"the arm does not move: {self.fault or 'it is not armed'}")
            move = safety.plan_move(self.config, tcp, state["tcp"], speed)
            deadline = time.monotonic() + move.most + self.config.patience
            self._elsewhere, self.touched, self.too_far = None, None, False
            self.pending = self._order(do, move.target, move.speed, **more), move, deadline
        return move

    def arrived(self) -> bool:
        """Whether the last move has started and ended and the arm is at its target."""
        pending = self.pending
        return pending is not None and self._ended(pending) and self._deviation(pending) is None

    def halt(self) -> None:
        """Revokes all commands and stops the arm, by the dashboard server if it does not stop in time. Moves
        may follow."""
        with self.lock:
            self.pending = None
            self.shared.control["stops"] += 1
            self._stop_by = time.monotonic() + DASHBOARD_DELAY

    def fail(self, outcome: SessionOutcome, detail: str) -> None:
        """Stops the arm with a fault, if it has none. After a contact the tool backs off along its path."""
        with self.lock:
            if self.fault is not None:
                return
            self.fault = Fault(outcome, detail, time.monotonic())
            self.halt()
            if outcome in PROCESS_LOST:
                self._kill_process()
                # Without the process no state shows the standstill; the controller's watchdog times out too.
                self._stop_by = None
                self._stop_by_dashboard()
            elif outcome in safety.SAFETY_STOPS:
                self._stop_by_dashboard()
            self._retreat_pending = outcome is SessionOutcome.CONTACT

    def _await_ready(self, process: _ArmProcess) -> None:
        patience = time.monotonic() + self.config.connect
        while not self.ready:
            with self.lock:
                ended = process.exit_finding()
                if ended is not None:
                    self._read_reports(process)
                refused = self.refused
            if refused is not None:
                raise refused
            if ended is not None:
                raise StartupRefused(ended.detail, "", "check the controller's ports 30003 and 30004")
            if time.monotonic() > patience:
                found = f"the controller did not start the control script in {self.config.connect:g} s"
                raise StartupRefused(found, "", "check the pendant: remote control on, no message waiting")
            time.sleep(TICK)

    def _kill_process(self) -> None:
        """Kills the process."""
        with self.lock:
            self.armed = False
            if self.process is not None:
                self.process.kill()
                self.process = None

    def _run(self) -> None:
        lateness = LatenessMeter(TICK, time.monotonic())
        while not self._closing.wait(TICK):
            now = time.monotonic()
            self._late = lateness.turn(now)
            self.supervise(now)

    def supervise(self, now: float) -> None:
        """Takes the reports of the process at a time (s, host), and acts on findings; its thread calls it."""
        self.shared.control["heartbeat"] = now
        with self.lock:
            if self.process is not None:
                self._read_reports(self.process)
            if self.process is not None and self.armed and self.fault is None:
                finding = self.process.exit_finding() or self._check_lateness(now)
                if finding is not None:
                    self.fail(*finding)
            self._follow_up(now)

    def _read_reports(self, process: _ArmProcess) -> None:
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
            elif report["say"] in ("touched", "unreachable"):
                if self.pending is not None and self.pending[0] == report["number"]:
                    self.pending, self.too_far = None, report["say"] == "unreachable"
                    self.touched = None if self.too_far else np.array(report["tcp"])
            elif report["say"] == "fault":
                outcome, detail = SessionOutcome[report["outcome"]], report["detail"]
                if self.armed:
                    self.fail(outcome, detail)
                else:
                    self.refused = StartupRefused(detail, "", outcome.value)

    def _check_lateness(self, now: float) -> Finding | None:
        """A finding if states are late, or the arm has not arrived in time."""
        age, pending = self.age(), self.pending
        if age > self.config.stale:
            late = max(self._late, float(self.shared.control["late"]))  # of this thread or the RTDE process
            return safety.stale_finding(age, late, self.config.stale)
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
        if state is None or safety.at_target(self.config, state["tcp"], target):
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
                target = safety.retreat_target(self.config, self.history)
                if target is not None:
                    self._order("retreat", target, safety.RETREAT_SPEED)
        elif now >= self._stop_by:
            self._stop_by_dashboard()
            self._stop_by = now + 2 * DASHBOARD_DELAY

    def _stop_by_dashboard(self) -> None:
        """Stops by the dashboard server, in a separate thread, so that the heartbeat never blocks."""
        threading.Thread(target=dashboard.stop_program, args=(self.config.host,), daemon=True).start()

    def _order(self, do: str, target: np.ndarray, speed: float, **more: Any) -> int:
        """Sends a command that the next stop revokes; returns its number."""
        self._number += 1
        stops, place = int(self.shared.control["stops"]), target.tolist()
        if self.process is not None:
            self.process.send(
                do=do, number=self._number, target=place, speed=float(speed), stops=stops, **more
            )
        return self._number
