"""Emulated arm and head, and sessions on them, each in a process of its own."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from robot.drivers.head.decoder import Frames
from robot.drivers.ur10.base_transform import BaseTransformConfig, tcp_from_pose
from robot.drivers.ur10.dashboard import Dashboard
from robot.emulators.head.config import HeadEmulatorConfig
from robot.recordings.cdr_live import Event
from robot.recordings.mcap_scanner import McapScanner
from robot.sources.source import Sample
from tests.helpers.live import HEAD_FAULTS, PATIENCE, ROOT, Faults, emulator, until, ur_emulator

SAMPLES = 2000.0
"""Frames of the head in a second."""
LEGS = tuple((0.63 + 0.07 * x, 0.45 + 0.02 * (x % 2), 0.0) for x in (0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0))
"""Route of quick sessions: legs of 1.6 s."""
START = tcp_from_pose(BaseTransformConfig(), np.array(LEGS[0]), 0.005)
HIGH = BaseTransformConfig(z=BaseTransformConfig().z - 0.3)
"""Pose of the map for the emulated head in quick sessions, too low for its whiskers to touch walls."""


class Moment(NamedTuple):
    """A moment by the devices' clocks: s of the controller, number of the head's newest sample."""

    robot: float
    sample: int


class RecordedData(NamedTuple):
    """Content of a recording."""

    sequence: np.ndarray
    robot: np.ndarray
    samples: list[Sample]
    events: list[Event]
    broken: str

    def lost(self, until: Moment) -> float:
        """Duration of the data missing at the end of the recording, of either device, s."""
        return max(until.robot - float(self.robot[-1]), (until.sample - int(self.sequence[-1])) / SAMPLES)

    def names(self) -> list[str]:
        return [event.name for event in self.events]


def raise_priority(pid: int) -> None:
    """Raises the priority of a process and its children where allowed, because they work in real time."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, -10)


def read_recorded(path: Path) -> RecordedData:
    """Reads a recording, complete or not."""
    walk = McapScanner(path)
    sequence, robot, samples, events = [], [], [], []
    for entry in walk.entries():
        if isinstance(entry.content, Frames):
            sequence.append(entry.content.sequence)
        elif isinstance(entry.content, np.ndarray):
            robot.append(entry.content["robot"])
        elif isinstance(entry.content, Event):
            events.append(entry.content)
        else:
            samples.append(entry.content)
    return RecordedData(np.concatenate(sequence), np.concatenate(robot), samples, events, walk.broken)


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
        os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


class SessionServer:
    """A process that has loaded all modules and forks sessions."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, 0
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.ratslam.live.session_server"],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == "ready\n"

    def start(
        self,
        config: dict[str, Any],
        mapper: float | None = 0.0,
        without: Sequence[str] = (),
        rate_check: bool = False,
        options: Sequence[str] = (),
    ) -> Session:
        """Starts a session.

        Args:
            config: its configuration. mapper: s that the stub takes for each sample; None: no stub, the
                mapper itself. without: libraries that it cannot import. rate_check: whether it checks the
                head's rate. options: more of `live`.
        """
        self._count += 1
        folder = self._folder / str(self._count)
        folder.mkdir()
        file, log, code = folder / "config.yaml", folder / "log", folder / "code"
        file.write_text(json.dumps(config))
        log.touch()
        order = {
            "arguments": ["live", str(file), "-o", str(folder / "run"), *options],
            "log": str(log),
            "code": str(code),
            "mapper": mapper,
            "rate_check": rate_check,
            "without": list(without),
        }
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(order) + "\n")
        session = Session(folder, Forked(int(self._process.stdout.readline()), code))
        raise_priority(session.process.pid)
        return session

    def close(self) -> None:
        self._process.kill()
        self._process.communicate()


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


class Bench:
    """An emulated arm and head at an address, started when needed and again after they ended."""

    def __init__(self, host: str, server: SessionServer, folder: Path) -> None:
        self.host, self._server, self._folder = host, server, folder
        self._arm, self._head = ExitStack(), ExitStack()
        self._faults: dict[str, Faults] = {}
        self.starved = 0  # number of stops by the controller's watchdog before the test

    @property
    def arm(self) -> Faults:
        """Faults of the controller."""
        return self._faults["arm"]

    @property
    def head(self) -> Faults:
        """Faults of the head."""
        return self._faults["head"]

    def ready(self) -> None:
        """Clears the faults of both devices and places the tool at `START`."""
        if not self._runs("arm"):
            self._arm.close()
            self._faults["arm"] = self._arm.enter_context(ur_emulator(self.host, START))
        if not self._runs("head"):
            self._head.close()
            self._faults["head"] = self._head.enter_context(self._a_head())
            raise_priority(self.head.process.pid)
        self.arm(do="clear")
        self.arm(do="wall")
        with Dashboard(self.host) as dashboard:
            dashboard.stop()
            if self.arm.state()["mode"] != "RUNNING":
                dashboard.ask("power on")
                dashboard.ask("brake release")
        until(self.still, "the arm stands")
        self.arm(do="place", tcp=START.tolist())
        self.starved = self.arm.state()["watchdog_stops"]
        self.head(do="plug")
        self.head(do="silence", seconds=0)

    @contextmanager
    def session(
        self,
        mapper: float | None = 0.0,
        without: Sequence[str] = (),
        rate_check: bool = False,
        options: Sequence[str] = (),
        **settings: Any,
    ) -> Iterator[Session]:
        """A quick session, started; its processes end with the block.

        Args:
            mapper: s that it takes for each sample; None: it maps. without: libraries that it cannot import.
            rate_check: whether it listens to the head for as long as in use and checks its rate.
            options: more of `live`. settings: of the section `live`.
        """
        config = {"live": self.quick(**settings)}
        session = self._server.start(config, mapper, without, rate_check, options)
        try:
            yield session
        finally:
            session.end()

    @contextmanager
    def in_motion(self, **settings: Any) -> Iterator[Session]:
        """A quick session after two whisks, with the arm at full speed."""
        with self.session(**settings) as session:
            session.wait_for("armed")
            session.until(
                lambda: self.whisk_count(session) >= 2 and self.moves(), "two whisks and an arm that moves"
            )
            yield session

    def quick(self, **settings: Any) -> dict[str, Any]:
        """The section `live` of a session of a few seconds, with time-outs for a busy machine."""
        arm = {"host": self.host, "stale": 30.0, "heartbeat": 30.0, "watchdog_hz": 0.05} | {
            "patience": PATIENCE,
            "connect": PATIENCE,
        }
        plan = {
            "whisking": {"rate": 4.0},
            "calibration": {"min_duration": 1.0},
            "motion": {"speed": 0.05},
        }
        head = {"address": self.host, "patience": PATIENCE, "silence": 20.0}
        usual = {
            "waypoints": LEGS,
            "lift": 0.01,
            "residual": 1.0,
            "room": 0.0,
            "grace": 1.0,
            "budget": PATIENCE,
        }
        given = {
            name: value | settings.pop(name, {})
            for name, value in {"arm": arm, "head": head, "plan": plan}.items()
        }
        return usual | given | settings

    def moment(self) -> Moment:
        """The present time by the devices' clocks."""
        return Moment(self.arm.state()["time"], self.head.state()["sequence"])

    def still(self) -> bool:
        """Whether the arm stands."""
        return not self.arm.state()["moving"]

    def moves(self) -> bool:
        """Whether the arm moves at full speed."""
        return float(np.linalg.norm(self.arm.state()["speed"][:3])) > 0.045

    def whisk_count(self, session: Session) -> int:
        """Number of whisks recorded, by the progress bar."""
        return max(map(int, re.findall(r"(\d+)/\d+ \[", session.output())), default=0)

    def replace_head(self) -> None:
        """Ends the emulated head, whose fault cannot be cleared; the next test gets a new one."""
        self.head.process.kill()
        self.head.process.wait(PATIENCE)

    def close(self) -> None:
        self._arm.close()
        self._head.close()

    def _runs(self, name: str) -> bool:
        return name in self._faults and self._faults[name].process.poll() is None

    def _a_head(self) -> Any:
        config = self._folder / "head.json"
        made = HeadEmulatorConfig(host=self.host, arm=self.host, placing=HIGH)
        config.write_text(made.model_dump_json())
        return emulator("robot.emulators.head", HEAD_FAULTS, self.host, "--config", str(config))
