"""An emulated Create with its whiskers, and what its own log says about the wheels."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tests.helpers.live import HEAD_FAULTS, ROOT, Faults, until

PLAN = {"arena": {"side": 1.25}, "wheels": {"noise": "bias"}, "seed": 7}
"""World and behaviour of every session: the robot drives ahead for 15 s, then touches a wall."""


class CreateBench:
    """An emulated Create in a process of its own.

    Attributes:
        port: its serial port, a link. process: the emulator. whiskers: faults of their bridge.
    """

    def __init__(self, host: str, folder: Path) -> None:
        self.host, self.port = host, str(folder / "create.tty")
        world = {"arena": PLAN["arena"], "wheels": PLAN["wheels"], "bridge": {"host": host}}
        config = {"port": self.port, "seed": PLAN["seed"], "world": world}
        self.process = subprocess.Popen(
            [sys.executable, "-m", "robot.emulators.create", "--config", json.dumps(config)],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        self.whiskers = Faults(self.process, host, HEAD_FAULTS)
        assert self.process.stdout is not None
        if not self.process.stdout.readline().endswith(b"ready\n"):
            self.close()
            raise AssertionError(f"the emulator does not start; does another one hold {host}?")

    def robot(self, do: str, **request: Any) -> dict[str, Any]:
        """Executes a request of the robot and its line."""
        return self.whiskers(device="create", do=do, **request)

    def state(self) -> dict[str, Any]:
        """State of the robot."""
        return self.robot("state")

    def rolls(self) -> bool:
        """Whether a wheel turns."""
        return any(self.state()["wheels"])

    def stopped_after(self, moment: float) -> float:
        """Time from a moment (s, host) until the wheels stood for good, s, by the robot's own log."""
        state = until(lambda: (found := self.state())["wheels"] == [0, 0] and found, "the wheels stand")
        moments = [state["began"] + at for at, right, left in state["speeds"] if not (right or left)]
        return max(0.0, moments[-1] - moment)

    def live(self, **settings: Any) -> dict[str, Any]:
        """The section `live` of a session on this robot."""
        create = {"port": self.port, "plan": {**PLAN, "minutes": 1}, **settings}
        return {"head": {"address": self.host}, "create": create, "room": 0.0, "residual": 1.0}

    def close(self) -> None:
        self.whiskers.close()
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()
        Path(self.port).unlink(missing_ok=True)  # its terminal's name is free for the next emulator


@contextmanager
def create_bench(host: str, folder: Path) -> Iterator[CreateBench]:
    """An emulated Create until the end of the block."""
    bench = CreateBench(host, folder)
    try:
        yield bench
    finally:
        bench.close()


def child_of(parent: int, word: bytes) -> int:
    """Process id of the child of a process that has a word in its command line."""
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError):
            if word in (folder / "cmdline").read_bytes() and _parent(folder) == parent:
                return int(folder.name)
    raise AssertionError(f"process {parent} has no child {word!r}")


def _parent(folder: Path) -> int:
    return int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])


def ended(pid: int, seconds: float = 30.0) -> None:
    """Waits until a process has ended."""

    def gone() -> bool:
        with suppress(OSError):
            return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
        return True

    until(gone, f"process {pid} ends", seconds)


def kill(pid: int, number: int) -> float:
    """Sends a signal; returns the time, s, host."""
    os.kill(pid, number)
    return time.monotonic()
