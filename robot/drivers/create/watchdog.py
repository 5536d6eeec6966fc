"""Watchdog process: stops the wheels when the driving process has died or hangs. The Create has no watchdog
of its own.

`python -m robot.drivers.create.watchdog PORT PATIENCE` is started by the driver and hears a beat, any
byte, from it on
standard input. Without one for PATIENCE s, or with the end of the input, it stops the wheels. A `q` ends it.
"""

from __future__ import annotations

import contextlib
import os
import queue
import subprocess
import sys
import threading

from robot.drivers.create import protocol
from robot.drivers.create.serial_link import open_port
from tactile.base.errors import InputError

START_LIMIT = 10.0
"""Time limit of the watchdog's start, s."""


class WatchdogFailed(InputError):
    """The watchdog process did not start."""


class Watchdog:
    """Starts the watchdog process and sends its heartbeat."""

    def __init__(self, port: str, patience: float) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "robot.drivers.create.watchdog", port, repr(patience)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,  # an interrupt from the terminal must not end it first
        )
        ready = threading.Thread(target=self._hear, daemon=True)
        self._heard = b""
        ready.start()
        ready.join(START_LIMIT)
        if self._heard != b"r":
            self.close()
            raise WatchdogFailed(port, "the watchdog process did not start")

    @property
    def pid(self) -> int:
        """Process id of the watchdog."""
        return self._process.pid

    def beat(self) -> bool:
        """Sends a heartbeat; False if the process has ended."""
        try:
            assert self._process.stdin is not None
            self._process.stdin.write(b".")
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Ends the process; the wheels are left as they are."""
        with contextlib.suppress(subprocess.TimeoutExpired, OSError):
            self._process.communicate(b"q", timeout=1)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe:
                with contextlib.suppress(OSError):
                    pipe.close()

    def _hear(self) -> None:
        assert self._process.stdout is not None
        self._heard = self._process.stdout.read(1)


def watch(port: str, patience: float) -> None:
    """The process: stops the wheels once for each time-out of the heartbeat."""
    line = open_port(port, exclusive=False)
    beats: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def hear() -> None:
        while data := os.read(0, 4096):
            beats.put(data)
        beats.put(b"")

    threading.Thread(target=hear, daemon=True).start()
    print("r", end="", flush=True)
    beating = False  # nothing drives before the first heartbeat
    while True:
        try:
            data = beats.get(timeout=patience if beating else None)
        except queue.Empty:
            data, beating = None, False
        if data and b"q" in data:
            return
        if data:
            beating = True
            continue
        try:
            line.write(protocol.STOP_ANYHOW)
        except OSError:  # the port is gone
            return
        if data is not None:
            return


if __name__ == "__main__":
    watch(sys.argv[1], float(sys.argv[2]))
