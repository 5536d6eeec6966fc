"""The processes of a session on this machine: their CPU priority, their lateness, and their signals.

Robot control comes before mapping, and mapping before drawing. Control gets a real-time policy where the
system allows it: beside busy programs, a process of high ordinary priority (nice level -10) still waits 0.1 s
and more for a processor, which is longer than an arm's watchdog. The lateness of a loop tells whether this
machine was late, or a device. Ctrl-C and SIGTERM are withheld from the processes of a session, which ends
them itself.
"""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType

WINDOW = 1.0
"""Time for which the largest delay counts, s."""
RETRY = 0.01
"""Time after which a Ctrl-C that came at a bad moment is sent again, s."""


def postpone_interrupt(frame: FrameType | None) -> bool:
    """Sends a Ctrl-C again after `RETRY`, if it came at a moment at which an exception is lost.

    In a callback of the garbage collector (JAX has one), Python would print the exception and go on; while a
    compiled module is imported, it would become an `ImportError`.

    Args:
        frame: where it came.

    Returns:
        whether it did so.
    """
    callbacks = [getattr(callback, "__code__", None) for callback in gc.callbacks]
    while frame is not None:
        code = frame.f_code
        if code in callbacks or code.co_qualname.startswith("ExtensionFileLoader."):
            threading.Timer(RETRY, os.kill, (os.getpid(), signal.SIGINT)).start()
            return True
        frame = frame.f_back
    return False


class LatenessMeter:
    """Measures by how much the turns of a loop come later than planned.

    Args:
        period: planned time between two turns, s. now: s.
    """

    def __init__(self, period: float, now: float) -> None:
        self._period, self._turned = period, now
        self._late, self._since = 0.0, now

    def turn(self, now: float) -> float:
        """Notes a turn of the loop at a time, s; returns the largest delay within the last `WINDOW`, s."""
        late = max(now - self._turned - self._period, 0.0)
        self._turned = now
        if late >= self.worst(now):
            self._late, self._since = late, now
        return self._late

    def worst(self, now: float) -> float:
        """The largest delay of a turn that ended within the last `WINDOW` before a time (s), s."""
        return self._late if now - self._since <= WINDOW else 0.0


URGENT = -10
"""Nice level of processes that control or emulate a robot, where the system refuses a real-time policy."""
BACKGROUND = 10
"""Nice levels by which a process that maps stands below the one that started it."""
LOWEST = 19
"""The nice level of processes that draw."""


def become_urgent() -> None:
    """Gives all threads of this process the priority of control, as far as the system allows."""
    for thread in _threads():
        _set(thread, URGENT, getattr(os, "SCHED_RR", 0))


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
        _set(thread, niceness, policy=0)


def put_last(process: int) -> None:
    """Gives a process that was just started, by its id, the lowest priority."""
    _set(process, LOWEST, policy=0)


def _set(thread: int, niceness: int, policy: int) -> None:
    """Sets nice level and policy of a thread (0: the ordinary one; the others have the least priority)."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(thread, policy, os.sched_param(os.sched_get_priority_min(policy)))
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, thread, niceness)


def _threads() -> list[int]:
    """Ids of the threads of this process; 0, the calling thread, where the system does not list them."""
    try:
        return [int(name) for name in os.listdir("/proc/self/task")]
    except OSError:
        return [0]


STOPS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def withheld_signals(stops: Collection[signal.Signals] = STOPS) -> Iterator[None]:
    """Processes started in the block, and their successors, get none of the signals from their first
    instruction on: a terminal, `timeout` and systemd send them to all processes of a program. In this process
    they wait for the end of the block."""
    resource_tracker.ensure_running()  # its start would end the block of the signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, stops)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
