"""The end of a session, and waiting for a condition while devices are polled."""

from __future__ import annotations

import time
from collections.abc import Callable

from robot.drivers.outcome import Fault, SessionOutcome

TICK = 0.01
"""Period of the poll, s."""


class SessionFault(Exception):
    """A fault ends the session."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(str(fault))
        self.fault = fault


class OperatorStop(Exception):
    """The operator ends the session."""


def session_fault(outcome: SessionOutcome, detail: str) -> SessionFault:
    """The exception that ends a session now."""
    return SessionFault(Fault(outcome, detail, time.monotonic()))


def wait_until(
    poll: Callable[[], None], done: Callable[[], bool], longest: float, late: SessionOutcome, what: str
) -> None:
    """Polls until a condition is true.

    Args:
        poll: reads the devices; raises at a fault. longest: time limit, s. late: outcome after that time.
        what: the awaited event, for the fault.

    Raises:
        SessionFault, OperatorStop.
    """
    due = time.monotonic() + longest
    while not done():
        if time.monotonic() > due:
            raise session_fault(late, f"{what} took more than {longest:g} s")
        poll()
        time.sleep(TICK)
