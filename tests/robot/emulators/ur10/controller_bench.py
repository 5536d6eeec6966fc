"""A controller without sockets, and a client that writes its registers."""

from __future__ import annotations

import math

from robot.emulators.ur10.controller import EmulatedController, Runtime
from robot.emulators.ur10.emulator_config import UrEmulatorConfig
from robot.emulators.ur10.server import DashboardSession, ScriptSession

PROGRAM = b"def rtde_control():\n    global reg_offset_int = # int register offset\n0\nend\n"
HERE = (0.6, 0.0, 0.3, math.pi, 0.0, 0.0)
THERE = (0.6, 0.1, 0.3, math.pi, 0.0, 0.0)
RUNNING = 1 << 15


class Bench:
    """A controller, its clock, and a client that writes registers as the library does."""

    def __init__(self, **settings: object) -> None:
        self.controller = EmulatedController(UrEmulatorConfig.model_validate(settings))
        self.host = 0.0
        self.script = ScriptSession(self.controller)
        self.dashboard = DashboardSession(self.controller)
        self.upload()

    def upload(self) -> None:
        self.script.receive(PROGRAM, self.host)
        self.ticks(0.1)

    def ticks(self, seconds: float) -> None:
        for _ in range(round(seconds / self.controller.dt)):
            self.host += self.controller.dt
            self.controller.tick(self.host)

    def write(self, command: int, doubles: tuple[float, ...] = (), asynchronous: int = 0) -> None:
        registers = self.controller.registers
        for index, number in enumerate(doubles):
            registers.write(f"input_double_register_{index}", (number,), self.host)
        registers.write("input_int_register_1", (asynchronous,), self.host)
        registers.write("input_int_register_0", (command,), self.host)

    def out(self, index: int) -> int:
        return int(self.controller.registers.fields[f"output_int_register_{index}"][0])

    def command(
        self, number: int, doubles: tuple[float, ...] = (), asynchronous: int = 0, wait: float = 30
    ) -> bool:
        """Sends a command and clears it when it is done; False without an answer within `wait` s."""
        assert self.out(0) == 1
        self.write(number, doubles, asynchronous)
        for _ in range(round(wait / self.controller.dt)):
            self.ticks(self.controller.dt)
            if self.out(0) == 2:
                self.write(0)
                self.ticks(0.02)
                return True
            if self.controller.runtime is not Runtime.PLAYING:
                self.write(0)
                return False
        return False

    def ask(self, line: str) -> str:
        return self.dashboard.receive(line.encode() + b"\n", self.host).decode().strip()
