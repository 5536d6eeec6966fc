"""CPU priority of processes: robot control before mapping, mapping before drawing.

Control gets a real-time policy where the system allows it: beside busy programs, a process of high ordinary
priority (nice level -10) still waits 0.1 s and more for a processor, which is longer than an arm's watchdog.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator

URGENT = -10
"""Nice level of processes that control or emulate a robot, where the system refuses a real-time policy."""
BACKGROUND = 10
"""Nice levels by which a process that maps stands below the one that started it."""
LOWEST = 19
"""The nice level of processes that draw."""


def become_urgent() -> None:
    """Gives all threads of this process the priority of control, as far as the system allows."""
    for thread in _threads():
        _set_niceness(thread, URGENT)
        with contextlib.suppress(OSError, AttributeError):
            os.sched_setscheduler(thread, os.SCHED_RR, os.sched_param(1))


@contextlib.contextmanager
def urgent() -> Iterator[None]:
    """Runs the block with the priority of control, as far as the system allows; then all threads of this
    process have the priority that the calling one had before."""
    niceness, policy = os.getpriority(os.PRIO_PROCESS, 0), 0
    with contextlib.suppress(OSError, AttributeError):
        policy = os.sched_getscheduler(0)
    become_urgent()
    try:
        yield
    finally:
        for thread in _threads():
            _set(thread, niceness, policy)


def step_back() -> None:
    """Lowers the priority of this process to `BACKGROUND` levels below the one that started it.

    It is relative because a mapper would hardly run beside other programs at a fixed low priority, which it
    needs only where the system refuses a higher one to the control process.
    """
    niceness = LOWEST
    with contextlib.suppress(OSError, AttributeError):
        niceness = min(LOWEST, os.getpriority(os.PRIO_PROCESS, os.getppid()) + BACKGROUND)
    for thread in _threads():
        _lower(thread, niceness)


def put_last(process: int) -> None:
    """Gives a process that was just started, by its id, the lowest priority."""
    _lower(process, LOWEST)


def _lower(thread: int, niceness: int) -> None:
    _set(thread, niceness, policy=0)


def _set(thread: int, niceness: int, policy: int) -> None:
    """Sets nice level and policy of a thread (0: the ordinary one; the others have the least priority)."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(thread, policy, os.sched_param(os.sched_get_priority_min(policy)))
    _set_niceness(thread, niceness)


def _set_niceness(thread: int, niceness: int) -> None:
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, thread, niceness)


def _threads() -> list[int]:
    """Ids of the threads of this process; 0, the calling thread, where the system does not list them."""
    try:
        return [int(name) for name in os.listdir("/proc/self/task")]
    except OSError:
        return [0]
