"""Findings about exceeded time limits: whether this machine was late, or the controller.

A machine that is late by half of a limit explains why the limit was exceeded.
"""

from __future__ import annotations

from robot.drivers.outcome import SessionOutcome
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import Finding

EXPLAINED_SHARE = 0.5


def stale_finding(age: float, late: float, limit: float) -> Finding:
    """No new state for `age` s, more than `limit` s.

    Args:
        late: lateness of this machine within the last second, s.
    """
    detail = f"no new state for {age:.3f} s"
    if late < EXPLAINED_SHARE * limit:
        return Finding(SessionOutcome.ARM_STALE, detail)
    return Finding(SessionOutcome.HOST_LATE, f"this machine was {late:.3f} s late: {detail}")


def silent_session_finding(silent: float) -> Finding:
    """No heartbeat of the session for `silent` s: the thread that sends it does little else."""
    detail = f"this machine was {silent:.3f} s late: the session sent no heartbeat for so long"
    return Finding(SessionOutcome.HOST_LATE, detail)


def ended_script_finding(config: ArmConfig, unreset: float, late: float) -> Finding:
    """The control script has ended on the controller.

    Args:
        unreset: longest time between two resets of its watchdog within the last second, s. late: lateness
            of this machine, s.
    """
    detail, limit = "the control script ended on the controller", 1 / config.watchdog_hz
    if unreset < limit:
        return Finding(SessionOutcome.ARM_GONE, detail)
    detail += f"; its watchdog was not reset for {unreset:.3f} s, and {limit:g} s are allowed"
    if late < EXPLAINED_SHARE * limit and not config.emulated:
        return Finding(SessionOutcome.ARM_GONE, detail)
    # An emulated controller answers late because this machine is.
    return Finding(
        SessionOutcome.HOST_LATE, f"this machine was {max(late, unreset - limit):.3f} s late: {detail}"
    )
