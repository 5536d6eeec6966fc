"""Commands that wait to be sent to a head, and those that a head that comes back is told again."""

from __future__ import annotations

import threading
from collections import deque

from robot.drivers.head.protocol import KEEP_ALIVE, Command, CommandKind

KEEP_ALIVE_PERIOD = 0.2
"""s between commands, at most; a head left alone for 0.5 s retracts."""
PERSISTENT = (CommandKind.CENTRE, CommandKind.DRIVE)
"""What stays true until it is told anew, in the order in which a head has to hear it."""


class CommandQueue:
    """Any thread puts commands in; the reader's takes them out."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[Command] = deque()
        self._lasting: dict[CommandKind, Command] = {}
        self._awake = False
        self._sent = -float("inf")

    def put(self, command: Command) -> None:
        """A command to send. Of amplitudes only the newest are worth sending."""
        with self._lock:
            if command.kind == CommandKind.AMPLITUDES:
                self._waiting = deque(other for other in self._waiting if other.kind != command.kind)
            if command.kind in PERSISTENT:
                self._lasting[command.kind] = command
            self._waiting.append(command)
            self._awake = True

    def rest(self) -> None:
        """Says no more: the head retracts by itself."""
        with self._lock:
            self._waiting.clear()
            self._lasting.clear()
            self._awake = False

    def resend_persistent(self) -> None:
        """The head has forgotten everything."""
        with self._lock:
            self._waiting = deque(self._lasting[kind] for kind in PERSISTENT if kind in self._lasting)

    def next(self, now: float) -> Command | None:
        """What to send now (s, host), if anything: a sign of life when there has been nothing else."""
        with self._lock:
            if self._waiting:
                return self._waiting[0]
            return KEEP_ALIVE if self._awake and now - self._sent >= KEEP_ALIVE_PERIOD else None

    def mark_sent(self, command: Command, now: float) -> None:
        """It went through at that time."""
        with self._lock:
            self._sent = now
            if self._waiting and self._waiting[0] is command:
                self._waiting.popleft()
