"""States of the arm in shared memory: one process writes them, others read, nobody waits.

A ring of slots. Its writer marks a slot as unfinished, fills it, writes the state's number into it, and only
then tells that number as the newest; a reader copies and then looks whether the numbers are still what they
were. Stores have to be seen in the order in which they were made; x86-64, where ur_rtde runs, does that.
"""

from __future__ import annotations

import contextlib
import sys
from multiprocessing import resource_tracker, shared_memory

import numpy as np

ARM_STATE = np.dtype(
    [
        ("counter", "u8"),  # of states since the session began, from 1
        ("host", "f8"),  # s, host's monotonic clock, when the state was seen
        ("robot", "f8"),  # s, the controller's clock
        ("tcp", "f8", 6),  # tool pose in the base frame: m, rotation vector rad
        ("speed", "f8", 6),  # its rate: m/s, rad/s
        ("force", "f8", 6),  # at the tool: N, Nm
        ("joints", "f8", 6),  # rad
        ("mode", "i4"),  # robot mode: 7 is running
        ("safety", "u4"),  # safety status bits
        ("runtime", "i4"),  # of the controller's program: 2 is playing
        ("operation", "i4"),  # number of the newest asynchronous operation, 0..127
        ("progress", "i4"),  # of it; -1: it has ended
    ],
    align=True,
)

CONTROL = np.dtype(
    [
        ("newest", "u8"),  # counter of the newest whole state; written by the arm's process
        ("heartbeat", "f8"),  # s, host's monotonic clock; written by the session
        ("stops", "u8"),  # how often the session has asked for a stop
        ("first", "u8"),  # counter of the first state of the arm's present process
    ]
)

SLOTS = 4096  # 8 s at 500 Hz
UNFINISHED = np.uint64(0)
HEADER = 64  # bytes; keeps the ring on a cache line of its own


class SharedState:
    """The ring and the few words beside it. `Board()` makes one, `Board(name)` opens another process's."""

    def __init__(self, name: str | None = None) -> None:
        size = HEADER + SLOTS * ARM_STATE.itemsize
        self._made = name is None
        self._memory = shared_memory.SharedMemory(name, create=self._made, size=size if self._made else 0)
        if not self._made and sys.platform != "win32":
            # Before Python 3.13 whoever opens a block also takes it away when it ends.
            resource_tracker.unregister(self._memory._name, "shared_memory")  # type: ignore[attr-defined]
        self.name = self._memory.name
        self.control = np.ndarray((), CONTROL, self._memory.buf)
        self._ring = np.ndarray(SLOTS, ARM_STATE, self._memory.buf, HEADER)

    @property
    def newest(self) -> int:
        """Counter of the newest state; 0 before the first."""
        return int(self.control["newest"])

    def publish(self, state: np.ndarray) -> None:
        """Append a state (STATE, one); its counter is set here. For one writer only."""
        counter = self.newest + 1
        slot = self._ring[counter % SLOTS]
        slot["counter"] = UNFINISHED
        state["counter"] = UNFINISHED
        self._ring[counter % SLOTS] = state
        slot["counter"] = state["counter"] = counter
        self.control["newest"] = counter

    def since(self, counter: int) -> np.ndarray:
        """All states [N] after that counter which are still in the ring, oldest first."""
        newest = self.newest
        wanted = np.arange(max(counter + 1, newest - SLOTS + 2, 1), newest + 1, dtype=np.uint64)
        slots = wanted % np.uint64(SLOTS)
        states = self._ring[slots]
        whole = (states["counter"] == wanted) & (self._ring["counter"][slots] == wanted)
        return states[whole]

    def latest(self) -> np.ndarray | None:
        """The newest state (STATE, one), or None before the first."""
        states = self.since(self.newest - 1)
        return states[-1] if len(states) else None

    def close(self) -> None:
        """Let go of the memory; who made it also takes it away."""
        self.control = np.zeros((), CONTROL)
        self._ring = np.zeros(1, ARM_STATE)
        with contextlib.suppress(BufferError):  # somebody still holds a view: it goes when the process does
            self._memory.close()
        if self._made:
            with contextlib.suppress(FileNotFoundError):
                self._memory.unlink()
