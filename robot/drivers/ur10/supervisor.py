"""The thread that watches an arm's process and its states, and sees that the arm stands when it must."""

from __future__ import annotations

import threading
import time
from typing import NamedTuple

import numpy as np

from robot.drivers.outcome import Fault, Outcome
from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.config import ArmConfig
from robot.drivers.ur10.process_handle import Process
from robot.drivers.ur10.safety import GENTLE, Finding, Move, arrived, retreat, still
from robot.drivers.ur10.shared_state import Board
from robot.drivers.ur10.startup_checks import Refusal, refusal_for

TICK = 0.005  # s
SECOND_WAY = 0.3  # s that a stop may take before the dashboard server is asked for it
SETTLED = 0.5  # s for which an arm must stand elsewhere than sent to count as not arrived
HISTORY = 5.0  # s of states kept for the log of a fault
LOST = {Outcome.ARM_STALE, Outcome.ARM_MALFORMED, Outcome.ARM_GONE, Outcome.CLOCK_JUMPED}
"""Ends after which nothing that the arm's process says is believed: it is killed."""
SAFETY_STOPS = {Outcome.PROTECTIVE_STOP, Outcome.SAFEGUARD_STOP, Outcome.EMERGENCY_STOP}
"""Ends after which a controller may resume its program by itself: the program is ended."""


class Errand(NamedTuple):
    """A move under way.

    Attributes:
        number: of the order. move: what was asked. deadline: s, host's clock.
    """

    number: int
    move: Move
    deadline: float


class Supervisor:
    """What is known of the arm's process, and the thread that finds out.

    Attributes:
        fault: what ended the motion; the first finding stays. ready: whether the process has settled.
        refused: why it could not connect. armed: whether findings count. lock: held to read and then act.
    """

    def __init__(self, config: ArmConfig, board: Board) -> None:
        self.config, self.board = config, board
        self.lock = threading.RLock()
        self.process: Process | None = None
        self.errand: Errand | None = None
        self.refused: Refusal | None = None
        self.fault: Fault | None = None
        self.ready = self.armed = False
        self._begun = (0, 0)  # order and the operation that was the newest before it
        self._done = 0
        self._number = 0
        self._elsewhere: float | None = None
        self._stop_by: float | None = None
        self._withdrawing = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="arm", daemon=True)

    def watch(self, process: Process) -> None:
        """Forget what was and watch this process."""
        with self.lock:
            self.fault, self.refused, self.errand, self._stop_by = None, None, None, None
            self.ready = self._withdrawing = False
            self.process = process
        if not self._thread.is_alive():
            self._thread.start()

    def arm(self) -> None:
        """From now on a finding is a fault; one that came before is a reason not to start, and raised."""
        with self.lock:
            if self.process is not None:
                self.hear(self.process)
            if self.refused is not None:
                raise self.refused
            self.armed = True

    def bury(self) -> None:
        """End the process, whatever it does."""
        with self.lock:
            self.armed = False
            if self.process is not None:
                self.process.kill()
                self.process = None

    def close(self) -> None:
        """End the thread."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join()

    def send(self, move: Move) -> None:
        """Order a move. To be called with the lock held."""
        deadline = time.monotonic() + move.most + self.config.patience
        self._elsewhere = None
        self.errand = Errand(self._order("move", move.target, move.speed), move, deadline)

    def halt(self) -> None:
        """Revoke all orders and stop; the second way if the arm does not stand in time."""
        with self.lock:
            self.errand = None
            self.board.control["stops"] += 1
            self._stop_by = time.monotonic() + SECOND_WAY

    def fail(self, finding: Finding) -> None:
        """Make a finding the fault, if it is the first, and see that the arm stands."""
        with self.lock:
            if self.fault is not None:
                return
            self.fault = Fault(finding.outcome, finding.detail, time.monotonic())
            self.halt()
            if finding.outcome in LOST:
                self.bury()
                # Nobody is left to show that the arm stands. Its watchdog has gone hungry as well.
                self._stop_by = None
                self._second_way()
            elif finding.outcome in SAFETY_STOPS:
                self._second_way()
            self._withdrawing = finding.outcome is Outcome.CONTACT

    def still(self) -> bool:
        """Whether the newest state is fresh and shows an arm at rest."""
        state = self.board.latest()
        return state is not None and self.age() <= self.config.stale and still(state)

    def age(self) -> float:
        """s since the newest state was seen; infinite before the first."""
        state = self.board.latest()
        return float("inf") if state is None else time.monotonic() - float(state["host"])

    def arrived(self, errand: Errand) -> bool:
        """Whether an errand has begun and ended and the arm stands where it was sent."""
        return self._ended(errand) and self._off(errand) is None

    def _run(self) -> None:
        while not self._closing.wait(TICK):
            now = time.monotonic()
            self.board.control["heartbeat"] = now
            with self.lock:
                if self.process is not None:
                    self.hear(self.process)
                if self.process is not None and self.armed and self.fault is None:
                    finding = self.process.ended() or self._late(now)
                    if finding is not None:
                        self.fail(finding)
                self._follow_up(now)

    def hear(self, process: Process) -> None:
        """Take in what the process has told."""
        for report in process.reports():
            if report["say"] == "ready":
                self.ready = True
            elif report["say"] == "refused":
                self.refused = refusal_for(report["detail"])
            elif report["say"] == "moving":
                self._begun = report["number"], report["operation"]
            elif report["say"] == "fault":
                outcome, detail = Outcome[report["outcome"]], report["detail"]
                if self.armed:
                    self.fail(Finding(outcome, detail))
                else:
                    self.refused = Refusal(detail, "", outcome.value)

    def _late(self, now: float) -> Finding | None:
        """Whether states are late, or the arm where it was sent."""
        age, errand = self.age(), self.errand
        if age > self.config.stale:
            return Finding(Outcome.ARM_STALE, f"no new state for {age:.3f} s")
        if errand is None or errand.number == self._done:
            return None
        off = self._off(errand)
        if off is None and self._ended(errand):
            self._done = errand.number
        elif off is not None and now > errand.deadline:
            return Finding(Outcome.NOT_ARRIVED, f"late, {off}")
        elif off is not None and self._ended(errand):
            self._elsewhere = self._elsewhere or now
            if now - self._elsewhere > SETTLED:
                return Finding(Outcome.NOT_ARRIVED, off)
        return None

    def _ended(self, errand: Errand) -> bool:
        """Whether the errand's operation has begun and ended and the arm is at rest."""
        state = self.board.latest()
        number, before = self._begun
        if state is None or number != errand.number or int(state["operation"]) == before:
            return False
        return int(state["progress"]) < 0 and self.still()

    def _off(self, errand: Errand) -> str | None:
        """How far the arm is from where it was sent; None if it is there."""
        state = self.board.latest()
        if state is None or arrived(self.config, state["tcp"], errand.move.target):
            return None
        way = float(np.linalg.norm(state["tcp"][:3] - errand.move.target[:3]))
        return f"{way * 1e3:.1f} mm from its target"

    def _follow_up(self, now: float) -> None:
        """A stop that does not show is asked for the second way; after a contact comes the way back."""
        if self._stop_by is None:
            return
        if self.still():
            self._stop_by = None
            if self._withdrawing:
                self._withdrawing = False
                target = retreat(self.config, self.history())
                if target is not None:
                    self._order("retreat", target, GENTLE)
        elif now >= self._stop_by:
            self._second_way()
            self._stop_by = now + 2 * SECOND_WAY

    def history(self) -> np.ndarray:
        """The last 5 s of states [N] (STATE)."""
        return self.board.since(max(0, self.board.newest - int(HISTORY * self.config.hz)))

    def _second_way(self) -> None:
        """In a thread of its own: the heart has to go on beating."""
        threading.Thread(target=dashboard.stop, args=(self.config.host,), daemon=True).start()

    def _order(self, do: str, target: np.ndarray, speed: float) -> int:
        """Send an order that the next stop revokes; its number."""
        self._number += 1
        stops = int(self.board.control["stops"])
        if self.process is not None:
            self.process.order(
                do=do, number=self._number, target=target.tolist(), speed=float(speed), stops=stops
            )
        return self._number
