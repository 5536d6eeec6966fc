"""CPU priority of processes: those that control the robot before mapping and drawing."""

from __future__ import annotations

import contextlib
import os

URGENT, BACKGROUND = -10, 10
"""Nice levels: of processes that control a robot or emulate one, and of those that map or draw."""


def set_niceness(niceness: int) -> None:
    """Sets the nice level of this process; without effect where the system does not allow it."""
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
