"""Arm states in shared memory: a lock-free ring buffer with one writer and several readers.

The writer marks a slot as unfinished, fills it, writes the state's counter into it and then publishes that
counter as the newest. A reader copies slots and then checks that their counters have not changed. This needs
stores to become visible in program order, which x86-64 guarantees (the only platform of ur_rtde).
"""

from __future__ import annotations

import contextlib
import mmap
import os
import tempfile

import numpy as np

ARM_STATE = np.dtype(
    [
        ("counter", "u8"),  # number of the state in the session, from 1
        ("host", "f8"),  # s, host's monotonic clock at receipt
        ("robot", "f8"),  # s, the controller's clock
        ("tcp", "f8", 6),  # tool pose in the base frame: m, rotation vector rad
        ("speed", "f8", 6),  # its rate: m/s, rad/s
        ("force", "f8", 6),  # at the tool: N, Nm
        ("joints", "f8", 6),  # rad
        ("mode", "i4"),  # robot mode: 7 is running
        ("safety", "u4"),  # safety status bits
        ("runtime", "i4"),  # of the controller's program: 2 is playing
        ("operation", "i4"),  # number of the newest asynchronous operation, 0..127
        ("progress", "i4"),  # progress of that operation; -1: it has ended
    ],
    align=True,
)

CONTROL = np.dtype(
    [
        ("newest", "u8"),  # counter of the newest complete state; written by the RTDE process
        ("heartbeat", "f8"),  # s, host's monotonic clock; written by the session
        ("stops", "u8"),  # number of stops that the session has requested
        ("first", "u8"),  # counter of the first state of the present RTDE process
        ("late", "f8"),  # s, lateness of the RTDE process within the last second; written by it
    ]
)

SLOTS = 4096  # 8 s at 500 Hz
UNFINISHED = np.uint64(0)
HEADER = 64  # bytes; keeps the ring on its own cache line


class SharedState:
    """The ring buffer of states and the control words beside it.

    The memory is an anonymous file: without a name, no file stays behind, and the kernel frees it at the end
    of the last process that has it open.

    Args:
        fd: file descriptor inherited from the process that created the memory; None creates it.

    Attributes:
        fd: file descriptor, to be passed to the other process. control: CONTROL, one.
    """

    def __init__(self, fd: int | None = None) -> None:
        size = HEADER + SLOTS * ARM_STATE.itemsize
        if fd is None:
            if hasattr(os, "memfd_create"):
                fd = os.memfd_create("arm states")
            else:
                with tempfile.TemporaryFile() as file:
                    fd = os.dup(file.fileno())
            os.ftruncate(fd, size)
        self.fd = fd
        self._memory = mmap.mmap(self.fd, size)
        self.control = np.ndarray((), CONTROL, self._memory)
        self._ring = np.ndarray(SLOTS, ARM_STATE, self._memory, HEADER)

    @property
    def newest(self) -> int:
        """Counter of the newest state; 0 before the first."""
        return int(self.control["newest"])

    def publish(self, state: np.ndarray) -> None:
        """Appends a state (ARM_STATE, one) and sets its counter. For one writer only."""
        counter = self.newest + 1
        slot = self._ring[counter % SLOTS]
        slot["counter"] = UNFINISHED
        state["counter"] = UNFINISHED
        self._ring[counter % SLOTS] = state
        slot["counter"] = state["counter"] = counter
        self.control["newest"] = counter

    def since(self, counter: int) -> np.ndarray:
        """Copies of the states [N] in the ring with counters above `counter`, oldest first."""
        newest = self.newest
        wanted = np.arange(max(counter + 1, newest - SLOTS + 2, 1), newest + 1, dtype=np.uint64)
        slots = wanted % np.uint64(SLOTS)
        states = self._ring[slots]
        whole = (states["counter"] == wanted) & (self._ring["counter"][slots] == wanted)
        return states[whole]

    def latest(self) -> np.ndarray | None:
        """The newest state (ARM_STATE, one); None before the first."""
        newest = self.newest
        state = self._ring[newest % SLOTS].copy()
        if state["counter"] == newest > 0 and self._ring["counter"][newest % SLOTS] == newest:
            return state
        states = self.since(newest - 1)  # it was overwritten meanwhile
        return states[-1] if len(states) else None

    def close(self) -> None:
        """Releases the memory in this process."""
        self.control = np.zeros((), CONTROL)
        self._ring = np.zeros(1, ARM_STATE)
        with contextlib.suppress(BufferError):  # a view in use keeps it until the process ends
            self._memory.close()
        with contextlib.suppress(OSError):  # already closed
            os.close(self.fd)
