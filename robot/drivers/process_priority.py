"""Who goes first on a busy machine: what moves or stands for a robot, before what can wait."""

from __future__ import annotations

import contextlib
import os

URGENT, BACKGROUND = -10, 10
"""Of processes that keep a robot's pace; of those that think or draw."""


def set_niceness(niceness: int) -> None:
    """Gives this process that niceness, where the system knows and allows it."""
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
