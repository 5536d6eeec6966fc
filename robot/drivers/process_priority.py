"""CPU priority of processes: robot control before mapping, mapping before drawing."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

URGENT = -10
"""Nice level of processes that control or emulate a robot."""
BACKGROUND = 10
"""Nice levels by which a process that maps stands below the one that started it."""
LOWEST = 19
"""The lowest priority there is."""


def set_niceness(niceness: int) -> None:
    """Sets the nice level of all threads of this process; without effect if the system refuses."""
    for thread in _threads():
        with contextlib.suppress(OSError, AttributeError):
            os.setpriority(os.PRIO_PROCESS, thread, niceness)


def step_back() -> None:
    """Lowers the priority of this process by `BACKGROUND` levels, from that of the process that started it.

    It is relative so that the distance is the same where the system refuses `URGENT`: a mapper at a fixed low
    priority would hardly run beside other programs, although the control process is safe from it anyway.
    """
    with contextlib.suppress(OSError, AttributeError):
        set_niceness(min(LOWEST, os.getpriority(os.PRIO_PROCESS, 0) + BACKGROUND))


@contextlib.contextmanager
def urgent() -> Iterator[None]:
    """Runs the block with the priority of robot control, as far as the system allows."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    set_niceness(URGENT)
    try:
        yield
    finally:
        set_niceness(before)


def _threads() -> list[int]:
    """Ids of the threads of this process; 0, the calling thread, where the system does not list them."""
    try:
        return [int(name) for name in os.listdir("/proc/self/task")]
    except OSError:
        return [0]
