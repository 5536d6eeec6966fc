"""CPU priority of processes: robot control before mapping and drawing."""

from __future__ import annotations

import contextlib
import os

URGENT, BACKGROUND = -10, 10
"""Nice levels of processes that control or emulate a robot, and of those that map or draw."""


def set_niceness(niceness: int) -> None:
    """Sets the nice level of this process; without effect if the system refuses."""
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
