"""Interface of the arm for a session: start after checks, move, halt, faults.

    with Arm(ArmConfig(host="192.168.1.10")) as arm:
        arm.start()                       # StartupRefused: a check failed, nothing has moved
        arm.move(tcp_of(config.placing, pose))
        while not arm.arrived() and arm.fault is None: ...

The first reason to stop becomes `fault`; after it every move is refused.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from robot.drivers.outcome import Fault, SessionOutcome
from robot.drivers.ur10 import dashboard
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import (
    Finding,
    Move,
    StartupRefused,
    TargetRefused,
    check_controller,
    check_states,
    plan_move,
)
from robot.drivers.ur10.shared_state import SharedState
from robot.drivers.ur10.supervisor import TICK, ArmProcess, Supervisor

__all__ = ["Arm", "StartupRefused", "TargetRefused"]


class Arm:
    """One arm. One thread calls its methods; a supervisor thread updates its state."""

    def __init__(self, config: ArmConfig) -> None:
        self.config = config
        self.shared = SharedState()
        self.supervisor = Supervisor(config, self.shared)

    def __enter__(self) -> Arm:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self) -> None:
        """Checks the controller, starts the RTDE process and checks its first states.

        Raises:
            StartupRefused: a check failed; nothing has moved."""
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

    def close(self) -> None:
        """Stops the arm, ends its process and releases threads and shared memory."""
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
        """The fault that stopped the arm, or None."""
        return self.supervisor.fault

    @property
    def pid(self) -> int | None:
        """Process id of the RTDE process; None without one."""
        process = self.supervisor.process
        return None if process is None else process.pid

    def states(self, after: int = 0) -> np.ndarray:
        """States [N] (ARM_STATE) in the ring buffer with counters above `after`, oldest first."""
        return self.shared.since(after)

    def latest(self) -> np.ndarray | None:
        """The newest state (ARM_STATE, one); None before the first."""
        return self.shared.latest()

    @property
    def history(self) -> np.ndarray:
        """States [N] (ARM_STATE) of the last 5 s."""
        return self.supervisor.history()

    def age(self) -> float:
        """Age of the newest state, s; infinite before the first."""
        return self.supervisor.age()

    def still(self) -> bool:
        """Whether the newest state is recent and shows an arm at rest."""
        return self.supervisor.still()

    def move(self, tcp: Any, speed: float | None = None) -> Move:
        """Starts a straight move of the tool to a pose [6] and returns at once. It replaces the present move.

        Raises:
            TargetRefused: the target is invalid, or the arm is not armed or has a fault.
        """
        supervisor = self.supervisor
        with supervisor.lock:  # a fault between check and command would not revoke it
            state = self.latest()
            if self.fault is not None or not supervisor.armed or state is None:
                raise TargetRefused(f"the arm does not move: {self.fault or 'it is not armed'}")
            move = plan_move(self.config, tcp, state["tcp"], speed)
            supervisor.send(move)
        return move

    def arrived(self) -> bool:
        """Whether the last move has started and ended and the arm is at its target."""
        pending = self.supervisor.pending
        return pending is not None and self.supervisor.arrived(pending)

    def halt(self) -> None:
        """Stops the arm, by the dashboard server if it does not stop in time. Moves may follow."""
        self.supervisor.halt()

    def fail(self, outcome: SessionOutcome, detail: str) -> None:
        """Stops the arm with a fault from another part; after a contact the tool backs off along its path."""
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
                raise StartupRefused(ended.detail, "", "check the controller's ports 30003 and 30004")
            if time.monotonic() > patience:
                raise StartupRefused(
                    f"the controller did not start the control script in {self.config.connect:g} s",
                    "",
                    "check the pendant: remote control on, no message waiting",
                )
            time.sleep(TICK)
