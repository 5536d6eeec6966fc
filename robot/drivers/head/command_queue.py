"""Queue of commands to a head, and the commands to repeat after a reconnection."""

from __future__ import annotations

import threading
from collections import deque

from robot.drivers.head.protocol import KEEP_ALIVE, Command, CommandKind

KEEP_ALIVE_PERIOD = 0.2
"""Longest time between commands, s; a head retracts 0.5 s after the last one."""
PERSISTENT = (CommandKind.CENTRE, CommandKind.DRIVE)
"""Commands that stay valid until replaced, in the order in which they are sent again."""


class CommandQueue:
    """Any thread adds commands; the reader's thread sends them."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._waiting: deque[Command] = deque()
        self._lasting: dict[CommandKind, Command] = {}
        self._awake = False
        self._sent = -float("inf")

    def put(self, command: Command) -> None:
        """Adds a command. Amplitudes replace queued ones."""
        with self._lock:
            if command.kind == CommandKind.AMPLITUDES:
                self._waiting = deque(other for other in self._waiting if other.kind != command.kind)
            if command.kind in PERSISTENT:
                self._lasting[command.kind] = command
            self._waiting.append(command)
            self._awake = True

    def rest(self) -> None:
        """Ends the keep-alive commands, so that the head retracts."""
        with self._lock:
            self._waiting.clear()
            self._lasting.clear()
            self._awake = False

    def resend_persistent(self) -> None:
        """Queues the persistent commands again, which a restarted head has lost."""
        with self._lock:
            self._waiting = deque(self._lasting[kind] for kind in PERSISTENT if kind in self._lasting)

    def next(self, now: float) -> Command | None:
        """The command to send at a host time, s, or None; a keep-alive if the queue is empty."""
        with self._lock:
            if self._waiting:
                return self._waiting[0]
            return KEEP_ALIVE if self._awake and now - self._sent >= KEEP_ALIVE_PERIOD else None

    def mark_sent(self, command: Command, now: float) -> None:
        """Removes a command sent at a host time, s."""
        with self._lock:
            self._sent = now
            if self._waiting and self._waiting[0] is command:
                self._waiting.popleft()
