"""A session's processes, its output and its files."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from tests.helpers.live import PATIENCE, until
from tests.ratslam.live.forked_process import Forked
from tests.ratslam.live.recorded_data import RecordedData, read_recorded


class Session:
    """A session's process.

    Attributes:
        directory: of its run. log: its output.
    """

    def __init__(self, folder: Path, process: Forked) -> None:
        self.directory, self.log, self.process = folder / "run", folder / "log", process

    def output(self) -> str:
        return self.log.read_text(errors="replace")

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """As `tests.helpers.live.until`; fails at once when the session has ended."""

        def met() -> Any:
            found = condition()
            assert found or self.process.poll() is None, self.output()
            return found

        try:
            return until(met, what)
        except AssertionError:
            print(self.output())
            raise

    def wait_for(self, text: str) -> None:
        """Waits for a text in its output."""
        self.until(lambda: text in self.output(), f"{text!r} is said")

    def code(self, seconds: float = 2 * PATIENCE) -> int:
        """Waits for its end; returns the exit code."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            print(self.output())
            raise

    def report(self) -> dict[str, Any]:
        """Content of `live.json`."""
        report: dict[str, Any] = json.loads((self.directory / "live.json").read_text())
        return report

    def recorded(self) -> RecordedData:
        """Content of its recording."""
        return read_recorded(self.directory / "session.mcap")

    def child(self) -> int:
        """Process id of its RTDE process."""
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                words = (folder / "cmdline").read_bytes().split(b"\0")
                if (
                    b"robot.drivers.ur10.rtde_process" in words
                    and os.getpgid(int(folder.name)) == self.process.pid
                ):
                    return int(folder.name)
        raise AssertionError("no process of the arm")

    def lives(self) -> bool:
        """Whether any of its processes runs."""
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if os.getpgid(int(folder.name)) == self.process.pid and _runs(folder):
                    return True
        return False

    def mapper(self) -> int:
        """Process id of its mapper."""
        return int((self.directory / "mapper.pid").read_text())

    def end(self) -> None:
        """Kills its processes."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(PATIENCE)


def _runs(folder: Path) -> bool:
    """Whether a process runs; a zombie does not."""
    return (folder / "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
