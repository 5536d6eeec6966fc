"""A process that a server has forked."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path


def raise_priority(pid: int) -> None:
    """Raises the priority of a process and its children where allowed, because they work in real time."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, -10)


class Forked:
    """A process started by a `SessionServer`, with the methods of `subprocess.Popen` that tests use."""

    def __init__(self, pid: int, code: Path) -> None:
        self.pid, self._code = pid, code

    def poll(self) -> int | None:
        return int(self._code.read_text()) if self._code.exists() else None

    def wait(self, timeout: float) -> int:
        end = time.monotonic() + timeout
        while (code := self.poll()) is None:
            if time.monotonic() > end:
                raise subprocess.TimeoutExpired("session", timeout)
            time.sleep(0.005)
        return code

    def send_signal(self, number: int) -> None:
        """Sends a signal; as in `Popen`, none to a process that has ended."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)
