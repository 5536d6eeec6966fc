"""Shared by tests of live parts: emulator processes, their fault ports, and waiting for a condition."""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
UR_FAULTS, HEAD_FAULTS = 30098, 30099
PATIENCE = 60.0
"""s that a test waits for something that a busy machine may delay; an idle one never needs them."""


class Faults:
    """The fault port of a running emulator: `faults(do="stall", seconds=3)` returns its answer."""

    def __init__(self, process: subprocess.Popen[bytes], host: str, port: int) -> None:
        self.process, self.host, self._port = process, host, port
        self._stream: socket.socket | None = None
        self._rest = b""

    def __call__(self, **request: Any) -> dict[str, Any]:
        if self._stream is None:
            self._stream = socket.create_connection((self.host, self._port), PATIENCE)
        self._stream.sendall(json.dumps(request).encode() + b"\n")
        while b"\n" not in self._rest:
            data = self._stream.recv(1 << 20)
            if not data:
                raise ConnectionError("the emulator hung up")
            self._rest += data
        line, self._rest = self._rest.split(b"\n", 1)
        answer: dict[str, Any] = json.loads(line)
        assert answer.get("ok", True), answer
        return answer

    def state(self) -> dict[str, Any]:
        return self(do="state")

    def die(self) -> None:
        """Ends the emulator at once; it does not answer."""
        with suppress(OSError, ValueError):
            self(do="die")
        self.process.wait(PATIENCE)

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()


@contextmanager
def started(command: Sequence[str], port: int, host: str) -> Iterator[Faults]:
    """The fault port of an emulator that `python COMMAND` has started; it ends with the block."""
    process = subprocess.Popen(
        [sys.executable, *command], cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, bufsize=0
    )
    faults = Faults(process, host, port)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert line.strip().endswith(b"ready"), f"it does not start; does another one hold {host}? {command}"
        yield faults
    finally:
        faults.close()
        process.kill()
        process.wait(PATIENCE)
        assert process.stdout is not None
        process.stdout.close()


def emulator(module: str, port: int, host: str, *arguments: str) -> AbstractContextManager[Faults]:
    """A running `python -m MODULE --host HOST ...`."""
    return started(["-m", module, "--host", host, *arguments], port, host)


def ur_emulator(host: str, start: Any, *arguments: str) -> Any:
    """An emulated UR controller whose tool stands at a pose [6]; a context manager of its Faults."""
    place = [repr(float(number)) for number in start]
    return emulator("robot.emulators.ur10", UR_FAULTS, host, *arguments, "--start", *place)


def moves(controller: Faults, after: int = 0) -> list[dict[str, Any]]:
    """Commands that a UR emulator received after the first `after`, without those that stop the arm."""
    return [order for order in controller.state()["targets"][after:] if not order["order"].startswith("Stop")]


def until(condition: Callable[[], Any], what: str = "", seconds: float = PATIENCE) -> Any:
    """Polls a condition and returns its value once it is true; fails after some seconds."""
    end = time.monotonic() + seconds
    while True:
        found = condition()
        if found:
            return found
        assert time.monotonic() < end, f"not in {seconds} s: {what or condition}"
        time.sleep(0.002)
