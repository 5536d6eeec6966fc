"""A Create in this process in simulated time, and one on a pseudo-terminal in real time."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

from robot.drivers.create.driver import PAUSE, ControlLoop
from robot.drivers.create.driver_config import CreateConfig
from robot.drivers.create.protocol import SAFE, START
from robot.drivers.create.serial_link import SerialLink
from robot.emulators.create import CreateEmulatorConfig, EmulatedCreate


class Line:
    """A serial port in memory: commands reach the robot at once, `mangle` changes its replies.

    Attributes:
        now: its clock, s; a read that times out advances it.
    """

    def __init__(self) -> None:
        self.robot = EmulatedCreate(CreateEmulatorConfig())
        self.now, self.timeout = 100.0, 0.0
        self.mangle: Callable[[bytes], bytes] = lambda reply: reply
        self.gone = False
        self._waiting = b""

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.robot.advance(seconds)

    def clock(self) -> float:
        return self.now

    @property
    def in_waiting(self) -> int:
        self._attached()
        return len(self._waiting)

    def read(self, size: int = 1) -> bytes:
        self._attached()
        data, self._waiting = self._waiting[:size], self._waiting[size:]
        if len(data) < size:
            self.wait(self.timeout or 0.0)
        return data

    def write(self, data: bytes) -> int:
        self._attached()
        for reply in self.robot.receive(data):
            self._waiting += self.mangle(reply)
        return len(data)

    def arrive(self, data: bytes) -> None:
        """Makes bytes arrive without a query."""
        self._waiting += data

    def close(self) -> None: ...

    def _attached(self) -> None:
        if self.gone:
            raise OSError(5, "Input/output error")

    def control_loop(self, **settings: Any) -> ControlLoop:
        """A control loop of this robot, which is awake and in safe mode."""
        link = SerialLink(self)
        for command in (START, SAFE):
            link.send(command)
            self.wait(PAUSE)
        link.ask(float("inf"))
        return ControlLoop(CreateConfig(**settings), link, self.clock)


class Emulated:
    """A process of the emulator."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "robot.emulators.create", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        assert self.process.stdout
        self.path = self.process.stdout.readline().split()[0]

    def do(self, what: str, **more: Any) -> Any:
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.write(json.dumps({"do": what, **more}) + "\n")
        return json.loads(self.process.stdout.readline())

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
