"""Watchdog process: stops the wheels when the driver's process has ended or hangs. The Create has none.

The driver starts `python -m robot.drivers.create.watchdog PORT BAUD PATIENCE REPLUG` and sends a heartbeat,
any byte, to its standard input, which it echoes. After PATIENCE s without one, or at the end of input, it
stops the wheels. If the port is gone then, it waits REPLUG s for its return and stops them then. `q` ends it.
"""

from __future__ import annotations

import contextlib
import math
import os
import queue
import subprocess
import sys
import threading
import time

from robot.drivers.create import protocol
from robot.drivers.create.serial_link import NoPort, PortBusy, open_port
from robot.drivers.processes import become_urgent, withheld_signals
from tactile.base.errors import InputError

START_LIMIT = 10.0
"""Time limit of the watchdog's start, s."""
RETRY = 0.05
"""Time between attempts to open a port that was disconnected, and between two stops on its return, s."""


class WatchdogFailed(InputError):
    """The watchdog process did not start."""


class Watchdog:
    """Starts the watchdog process and sends its heartbeat.

    Args:
        baud: speed of the port. patience: time without a heartbeat, or without its echo, that counts as a
            hang, s. replug: time for which the process waits for a port that was disconnected, s.
    """

    def __init__(self, port: str, baud: int, patience: float, replug: float) -> None:
        words = port, str(baud), repr(patience), repr(replug)
        command = [sys.executable, "-m", "robot.drivers.create.watchdog", *words]
        with withheld_signals():  # they must not end it before the session
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0, start_new_session=True
            )
        self._patience = patience
        self._beaten = self._heard = -math.inf  # times of the last beat and of the last echo
        self._ready = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True, name="watchdog echo")
        self._reader.start()
        if not self._ready.wait(START_LIMIT):
            self.close()
            raise WatchdogFailed(port, "the watchdog process did not start")

    @property
    def pid(self) -> int:
        """Process id of the watchdog."""
        return self._process.pid

    def beat(self) -> bool:
        """Sends a heartbeat; False if the process has ended or hangs."""
        now = time.monotonic()
        if now - self._beaten > self._patience:  # the first, or this process hung: an echo may be unread
            self._heard = now
        self._beaten = now
        try:
            assert self._process.stdin is not None
            self._process.stdin.write(b".")
        except OSError:
            return False
        return now - self._heard <= self._patience

    def close(self) -> None:
        """Ends the process without a command to the wheels."""
        with contextlib.suppress(OSError):
            assert self._process.stdin is not None
            self._process.stdin.write(b"q")
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1)
        if self._process.poll() is None:
            self._process.kill()
        self._close_pipes()

    def leave(self) -> None:
        """Leaves the process to stop the robot when its port returns."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        threading.Thread(target=self._close_pipes, daemon=True, name="watchdog end").start()

    def _close_pipes(self) -> None:
        """Waits for the end of the process, then releases its pipes."""
        self._process.wait()
        self._reader.join(1)
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe:
                with contextlib.suppress(OSError):
                    pipe.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        while self._process.stdout.read(1):
            self._heard = time.monotonic()
            self._ready.set()


def _watch(port: str, baud: int, patience: float, replug: float) -> None:
    """Runs the watchdog: stops the wheels once per time-out of the heartbeat (`patience`, s)."""
    line = open_port(port, baud, exclusive=False)
    beats: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def read_beats() -> None:
        while data := os.read(0, 4096):
            beats.put(data)
        beats.put(b"")

    threading.Thread(target=read_beats, daemon=True).start()
    _say(b"r")
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
            _say(b".")
            continue
        try:
            line.write(protocol.STOP_ANYHOW)
        except OSError:
            line.close()  # else the system may give the returning port another name
            _stop_on_return(port, baud, replug)
            return
        if data is not None:
            return


def _stop_on_return(port: str, baud: int, replug: float) -> None:
    """Waits for a disconnected port and stops the robot on it, which then leaves safe mode.

    Ends without a command if another program has the port: a new session stops the robot itself.
    """
    end = time.monotonic() + replug
    while time.monotonic() < end:
        try:
            if os.name == "nt" or os.path.exists(port):
                line = open_port(port, baud)
                for _ in range(2):  # the first bytes after the connection may be lost
                    line.write(protocol.STOP_ANYHOW)
                    time.sleep(RETRY)
                line.write(protocol.START)
                time.sleep(RETRY)  # until the byte is on the line
                line.close()
                return
        except PortBusy:
            return
        except (NoPort, OSError):
            pass  # not yet
        time.sleep(RETRY)


def _say(word: bytes) -> None:
    with contextlib.suppress(OSError):  # the driver's process has ended
        os.write(1, word)


if __name__ == "__main__":
    become_urgent()
    _watch(sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4]))
