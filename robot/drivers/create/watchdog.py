"""Watchdog process: stops the wheels when the driver's process has ended or hangs. The Create has none.

The driver starts `python -m robot.drivers.create.watchdog PORT PATIENCE` and sends a heartbeat, any byte, to
its standard input. After PATIENCE s without one, or at the end of input, it stops the wheels. `q` ends it.
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
        ready = threading.Thread(target=self._read_ready, daemon=True)
        self._ready = b""
        ready.start()
        ready.join(START_LIMIT)
        if self._ready != b"r":
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
        """Ends the process without a command to the wheels."""
        with contextlib.suppress(subprocess.TimeoutExpired, OSError):
            self._process.communicate(b"q", timeout=1)
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe:
                with contextlib.suppress(OSError):
                    pipe.close()

    def _read_ready(self) -> None:
        assert self._process.stdout is not None
        self._ready = self._process.stdout.read(1)


def watch(port: str, patience: float) -> None:
    """Runs the watchdog: stops the wheels once per time-out of the heartbeat (`patience`, s)."""
    line = open_port(port, exclusive=False)
    beats: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read_beats() -> None:
        while data := os.read(0, 4096):
            beats.put(data)
        beats.put(b"")

    threading.Thread(target=read_beats, daemon=True).start()
    print("r", end="", flush=True)
    beating = False  # the wheels are still before the first heartbeat
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
        except OSError:  # the port was disconnected
            return
        if data is not None:
            return


if __name__ == "__main__":
    watch(sys.argv[1], float(sys.argv[2]))
