"""The arm as a session knows it: started after checks, moved, watched by a thread, stopped by two ways.

    with Arm(ArmConfig(host="192.168.1.10")) as arm:
        arm.start()                       # raises Refusal: it never moved, and why
        arm.move(tcp_of(config.placing, pose))
        while not arm.arrived() and arm.fault is None: ...

Whatever ends a session's motion becomes `fault`, once; nothing moves after it until `respawn`.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from robot.drivers.outcome import Fault, SessionOutcome
from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.config import ArmConfig
from robot.drivers.ur10.process_handle import ArmProcess
from robot.drivers.ur10.safety import Finding, Move, TargetRefused, plan_move
from robot.drivers.ur10.shared_state import SharedState
from robot.drivers.ur10.startup_checks import StartupRefused, check_controller, check_states
from robot.drivers.ur10.supervisor import TICK, Supervisor

__all__ = ["Arm", "StartupRefused", "TargetRefused"]


class Arm:
    """One arm. Its methods are for one thread; what they tell, a supervisor keeps up to date in another."""

    def __init__(self, config: ArmConfig) -> None:
        self.config = config
        self.reason = ""
        """Why it was last halted."""
        self.shared = SharedState()
        self.supervisor = Supervisor(config, self.shared)

    def __enter__(self) -> Arm:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Check the controller, start the arm's process, check what it sees; raises Refusal."""
        check_controller(self.config)
        first = self.shared.newest + 1
        self.shared.control["first"] = first
        self.shared.control["heartbeat"] = time.monotonic()
        process = ArmProcess(self.shared.fd, self.config)
        self.supervisor.watch(process)
        try:
            self._await_ready(process)
            check_states(self.config, lambda: self.states(first - 1))
            self.supervisor.arm()
        except BaseException:
            self.supervisor.kill_process()
            raise

    def respawn(self) -> None:
        """Start anew after a fault, with all checks; the pose may be another one, so this is no odometry."""
        self.supervisor.kill_process()
        dashboard.stop_program(self.config.host)
        self.reason = ""
        self.start()

    def close(self) -> None:
        """Stop the arm, end its process, let go of everything."""
        supervisor = self.supervisor
        supervisor.armed = False
        if supervisor.process is not None and not supervisor.process.end(1.0):
            supervisor.kill_process()
            dashboard.stop_program(self.config.host)
        supervisor.kill_process()
        supervisor.close()
        self.shared.close()

    @property
    def fault(self) -> Fault | None:
        """What ended the motion; None while all is well."""
        return self.supervisor.fault

    @property
    def pid(self) -> int | None:
        """Of the arm's process, while there is one."""
        process = self.supervisor.process
        return None if process is None else process.pid

    def states(self, after: int = 0) -> np.ndarray:
        """All states [N] (STATE) whose counter is larger, as far as the ring reaches back, oldest first."""
        return self.shared.since(after)

    def latest(self) -> np.ndarray | None:
        """The newest state (STATE, one); None before the first."""
        return self.shared.latest()

    @property
    def history(self) -> np.ndarray:
        """The last 5 s of states [N] (STATE): what to keep of a fault."""
        return self.supervisor.history()

    def age(self) -> float:
        """s since the newest state was seen; infinite before the first."""
        return self.supervisor.age()

    def still(self) -> bool:
        """Whether the newest state is fresh and shows an arm at rest."""
        return self.supervisor.still()

    def move(self, tcp: Any, speed: float | None = None) -> Move:
        """Send the tool to a pose [6] in a straight line; returns at once. A newer move replaces an older.

        Raises:
            Refused: the target is not one, or the arm is not armed, or has a fault.
        """
        supervisor = self.supervisor
        with supervisor.lock:  # a fault that is found meanwhile would not revoke the order
            state = self.latest()
            if self.fault is not None or not supervisor.armed or state is None:
                raise TargetRefused(f"the arm does not move: {self.fault or 'it is not armed'}")
            move = plan_move(self.config, tcp, state["tcp"], speed)
            supervisor.send(move)
        return move

    def arrived(self) -> bool:
        """Whether the last move has begun, has ended, and the arm stands where it was sent."""
        errand = self.supervisor.pending
        return errand is not None and self.supervisor.arrived(errand)

    def halt(self, reason: str) -> None:
        """Stop, controlled; by the dashboard server if the arm does not stand in time. Moves may follow."""
        self.reason = reason
        self.supervisor.halt()

    def fail(self, outcome: SessionOutcome, detail: str) -> None:
        """Stop because of what somebody else found; on a contact the tool backs off the way it came."""
        self.supervisor.fail(Finding(outcome, detail))

    def _await_ready(self, process: ArmProcess) -> None:
        supervisor = self.supervisor
        patience = time.monotonic() + self.config.connect
        while not supervisor.ready:
            with supervisor.lock:
                ended = process.exit_finding()
                if ended is not None:
                    supervisor.read_reports(process)
                refused = supervisor.refused
            if refused is not None:
                raise refused
            if ended is not None:
                raise StartupRefused(ended.detail, "", "look at the controller's ports 30003 and 30004")
            if time.monotonic() > patience:
                raise StartupRefused(
                    f"the controller did not take the control script in {self.config.connect:g} s",
                    "",
                    "look at the pendant: remote control on, no message waiting",
                )
            time.sleep(TICK)
