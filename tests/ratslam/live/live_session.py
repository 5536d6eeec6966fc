"""Sessions that a server forks: processes, output, files, the content of a recording."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robot.drivers.head.decoder import Frames
from robot.recordings.cdr import Event
from robot.recordings.mcap_reader import McapScanner
from robot.sources.source import Sample
from tests.helpers.live import PATIENCE, ROOT, until

CODES = {"complete": (0,), "interrupted": (130, 143)}
"""Exit codes of outcomes; that of all others is 2."""


class Moment(NamedTuple):
    """A moment by the devices' clocks: s of the controller, number of the head's newest sample."""

    robot: float
    sample: int


class RecordedData(NamedTuple):
    sequence: np.ndarray
    robot: np.ndarray
    samples: list[Sample]
    events: list[Event]
    broken: str

    def lost(self, until: Moment) -> float:
        """Duration of the data missing at the end of the recording, of either device, s."""
        return max(until.robot - float(self.robot[-1]), (until.sample - int(self.sequence[-1])) / 2000)

    def names(self) -> list[str]:
        return [event.name for event in self.events]


def read_recorded(path: Path) -> RecordedData:
    walk = McapScanner(path)
    content = [entry.content for entry in walk.entries()]
    frames, states, samples, events = (
        [part for part in content if isinstance(part, kind)] for kind in (Frames, np.ndarray, Sample, Event)
    )
    sequence = np.concatenate([part.sequence for part in frames])
    robot = np.concatenate([part["robot"] for part in states])
    return RecordedData(sequence, robot, samples, events, walk.broken)


def raise_priority(pid: int) -> None:
    """Raises the priority of a process and its children where allowed, because they work in real time."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, -10)


def child_of(parent: int, word: bytes) -> int:
    """Process id of the child of a process that has a word in its command line."""
    for listed in Path(f"/proc/{parent}/task").glob("*/children"):
        for child in listed.read_text().split():
            with suppress(OSError):
                if word in Path(f"/proc/{child}/cmdline").read_bytes():
                    return int(child)
    raise AssertionError(f"process {parent} has no child {word!r}")


class Session:
    """A session: its process, the directory of its run, its output (`log`)."""

    def __init__(self, folder: Path, pid: int) -> None:
        self.directory, self.log, self.pid = folder / "run", folder / "log", pid
        self._code = folder / "code"

    def output(self) -> str:
        return self.log.read_text(errors="replace")

    def ended(self) -> bool:
        return self._code.exists()

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """As `tests.helpers.live.until`; fails at once when the session has ended."""

        def met() -> Any:
            found = condition()
            assert found or not self.ended(), self.output()
            return found

        return until(met, what, 4 * PATIENCE)

    def wait_for(self, text: str) -> None:
        self.until(lambda: text in self.output(), f"{text!r} is said")

    def code(self, seconds: float = 4 * PATIENCE) -> int:
        until(self.ended, f"the session ends\n{self.output()}", seconds)
        return int(self._code.read_text())

    def report(self) -> Any:
        return json.loads((self.directory / "live.json").read_text())

    def ends(self, outcome: str) -> dict[str, Any]:
        """The report of a session that ends by itself with an outcome."""
        code, report = self.code(), self.report()
        assert report["outcome"] == outcome, self.output()
        assert code in CODES.get(outcome, (2,))
        assert f"{outcome}: " in self.output()
        assert "Traceback" not in self.output(), self.output()
        return report

    def recorded(self) -> RecordedData:
        return read_recorded(self.directory / "session.mcap")

    def child(self, word: bytes) -> int:
        return child_of(self.pid, word)

    def lives(self) -> bool:
        """Whether any of its processes runs; a zombie does not."""
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                state = (folder / "stat").read_text().rsplit(")", 1)[1].split()[0]
                if os.getpgid(int(folder.name)) == self.pid and state != "Z":
                    return True
        return False

    def send(self, number: int) -> None:
        """Sends a signal to its process, unless it has ended."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, number)

    def send_to_all(self, number: int) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self.pid, number)


class SessionServer:
    """A process that has loaded all modules and forks sessions."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, 0
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.ratslam.live.session_server"],
            cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
        )  # fmt: skip
        assert self._process.stdout.readline() == "ready\n"

    @contextmanager
    def session(
        self, config: dict[str, Any], options: Sequence[str] = (), mapper: float | None = 0.0, **order: Any
    ) -> Iterator[Session]:
        """A session, started with more options of `live`; its processes end with the block. `mapper`: s that
        the stub takes for each sample, None for no stub; `order`: see `session_server`."""
        self._count += 1
        folder = self._folder / str(self._count)
        folder.mkdir()
        file = folder / "config.yaml"
        file.write_text(json.dumps(config))
        (folder / "log").touch()
        arguments = ["live", str(file), "-o", str(folder / "run"), *options]
        order = {"environment": {}, "rate_check": False} | order
        order |= {"folder": str(folder), "arguments": arguments, "mapper": mapper}
        self._process.stdin.write(json.dumps(order) + "\n")
        session = Session(folder, int(self._process.stdout.readline()))
        raise_priority(session.pid)
        try:
            yield session
        finally:
            session.send_to_all(signal.SIGKILL)
            session.code()

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()
