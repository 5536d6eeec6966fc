"""Emulated arm and head, and sessions on them, each in a process of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
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
from tests.helpers.live import HEAD_FAULTS, ROOT, Faults, emulator, until, ur_emulator

SAMPLES = 2000.0
"""Frames of the head in a second."""
LEGS = tuple((0.63 + 0.07 * x, 0.45 + 0.02 * (x % 2), 0.0) for x in (0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0))
"""Where quick sessions go: legs of 1.6 s."""
START = tcp_from_pose(BaseTransformConfig(), np.array(LEGS[0]), 0.005)
HIGH = BaseTransformConfig(z=BaseTransformConfig().z - 0.3)
"""Where the head believes the map to be in quick sessions: whiskers meet nothing."""


class Moment(NamedTuple):
    """A moment by the devices' clocks: s of the controller, number of the head's newest sample."""

    robot: float
    sample: int


class Kept(NamedTuple):
    """What a recording holds."""

    sequence: np.ndarray
    robot: np.ndarray
    samples: list[Sample]
    events: list[Event]
    broken: str

    def lost(self, until: Moment) -> float:
        """s that are missing of what either device had sent by then."""
        return max(until.robot - float(self.robot[-1]), (until.sample - int(self.sequence[-1])) / SAMPLES)

    def names(self) -> list[str]:
        return [event.name for event in self.events]


def undisturbed(pid: int) -> None:
    """Lets a process, and those that it will start, go before others where that is allowed: a device and a
    session have their time for themselves."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, -10)


def kept(path: Path) -> Kept:
    """Reads a recording, whole or not."""
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
    return Kept(np.concatenate(sequence), np.concatenate(robot), samples, events, walk.broken)


class Session:
    """A session's process. It waits with everything loaded until `begin`.

    Attributes:
        directory: of its run. log: what it says.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir()
        self.directory, self.log = folder / "run", folder / "log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tests.ratslam.live.waiting_session"],
                cwd=ROOT,
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def begin(self, arguments: list[str], **others: Any) -> None:
        """Has it run the program with these arguments, in its own directory."""
        undisturbed(self.process.pid)
        assert self.process.stdin is not None
        told = {"arguments": [*arguments, "-o", str(self.directory)], "mapper": 0.0, "listened": 0.7}
        self.process.stdin.write(json.dumps(told | others).encode() + b"\n")
        self.process.stdin.flush()

    def said(self) -> str:
        return self.log.read_text(errors="replace")

    def until(self, condition: Callable[[], Any], seconds: float, what: str) -> Any:
        """As `live_helpers.until`, but a session that has ended ends the waiting too."""

        def met() -> Any:
            found = condition()
            assert found or self.process.poll() is None, self.said()
            return found

        try:
            return until(met, seconds, what)
        except AssertionError:
            print(self.said())
            raise

    def says(self, text: str, seconds: float = 30.0) -> None:
        """Waits until it has said something."""
        self.until(lambda: text in self.said(), seconds, f"{text!r} is said")

    def code(self, seconds: float = 20.0) -> int:
        """Its exit code, once it ends."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            print(self.said())
            raise

    def report(self) -> dict[str, Any]:
        """`live.json`"""
        report: dict[str, Any] = json.loads((self.directory / "live.json").read_text())
        return report

    def kept(self) -> Kept:
        """What it has recorded."""
        return kept(self.directory / "session.mcap")

    def child(self) -> int:
        """Process of the arm."""
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
        """Whether any process of it does."""
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if os.getpgid(int(folder.name)) == self.process.pid and _runs(folder):
                    return True
        return False

    def mapper(self) -> int:
        """Process of the mapper."""
        return int((self.directory / "mapper.pid").read_text())

    def end(self) -> None:
        """Nothing of it stays."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(5)
        assert self.process.stdin is not None
        with suppress(OSError):
            self.process.stdin.close()


def _runs(folder: Path) -> bool:
    """Whether a process does something; one that only waits to be buried does not."""
    return (folder / "stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"


class Queue:
    """A session that waits for its turn, and behind it always another one."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._count = folder, 0
        self._waiting: Session | None = None

    def take(self) -> Session:
        """The one whose turn it is; whoever takes it ends it."""
        session, self._waiting = self._waiting or self._next(), self._next()
        session.until(lambda: "waiting" in session.said(), 60.0, "it has loaded everything")
        return session

    def close(self) -> None:
        if self._waiting is not None:
            self._waiting.end()

    def _next(self) -> Session:
        self._count += 1
        return Session(self._folder / str(self._count))


class Bench:
    """An address with an emulated arm and head, started when they are wanted and as often as it takes."""

    def __init__(self, host: str, queue: Queue, folder: Path) -> None:
        self.host, self._queue, self._folder = host, queue, folder
        self._arm, self._head = ExitStack(), ExitStack()
        self._faults: dict[str, Faults] = {}
        self.starved = 0  # stops by the controller's watchdog, before the test

    @property
    def arm(self) -> Faults:
        """Faults of the controller."""
        return self._faults["arm"]

    @property
    def head(self) -> Faults:
        """Faults of the head."""
        return self._faults["head"]

    def ready(self) -> None:
        """Both devices are in good order, the tool at `START`."""
        if not self._runs("arm"):
            self._arm.close()
            self._faults["arm"] = self._arm.enter_context(ur_emulator(self.host, START))
        if not self._runs("head"):
            self._head.close()
            self._faults["head"] = self._head.enter_context(self._a_head())
            undisturbed(self.head.process.pid)
        self.arm(do="clear")
        self.arm(do="wall")
        with Dashboard(self.host) as dashboard:
            dashboard.stop()
            if self.arm.state()["mode"] != "RUNNING":
                dashboard.ask("power on")
                dashboard.ask("brake release")
        until(self.still, 2.0, "the arm stands")
        self.arm(do="place", tcp=START.tolist())
        self.starved = self.arm.state()["watchdog_stops"]
        self.head(do="plug")
        self.head(do="silence", seconds=0)

    @contextmanager
    def session(self, mapper: float = 0.0, **settings: Any) -> Iterator[Session]:
        """A quick session, begun; nothing of it stays behind.

        Args:
            mapper: s that it takes for each sample. settings: of the section `live`.
        """
        session = self._queue.take()
        try:
            config = session.directory.parent / "config.yaml"
            config.write_text(json.dumps({"live": self.quick(**settings)}))
            session.begin(["live", str(config)], mapper=mapper)
            yield session
        finally:
            session.end()

    @contextmanager
    def under_way(self, **settings: Any) -> Iterator[Session]:
        """The same, some whisks later, with the arm at full speed."""
        with self.session(**settings) as session:
            session.says("armed")
            began = time.monotonic()
            session.until(lambda: time.monotonic() - began > 0.8 and self.moves(), 10.0, "the arm moves")
            yield session

    def quick(self, **settings: Any) -> dict[str, Any]:
        """The section `live` of a session that takes a few seconds and, of a busy machine, much."""
        arm = {"host": self.host, "stale": 0.5, "heartbeat": 0.5, "watchdog_hz": 4.0}
        plan = {
            "whisking": {"rate": 4.0},
            "calibration": {"shortest": 1.0},
            "motion": {"speed": 0.05},
        }
        head = {"address": self.host, "patience": 0.6, "silence": 0.25}
        usual = {"waypoints": LEGS, "lift": 0.01, "residual": 1.0, "room": 0.0}
        given = {
            name: value | settings.pop(name, {})
            for name, value in {"arm": arm, "head": head, "plan": plan}.items()
        }
        return usual | given | settings

    def moment(self) -> Moment:
        """Now, by the devices' clocks."""
        return Moment(self.arm.state()["time"], self.head.state()["sequence"])

    def still(self) -> bool:
        """Whether the arm stands."""
        return not self.arm.state()["moving"]

    def moves(self) -> bool:
        """Whether it goes at full speed."""
        return float(np.linalg.norm(self.arm.state()["speed"][:3])) > 0.045

    def worn(self) -> None:
        """The head cannot be put right: the next test gets another one."""
        self.head.process.kill()
        self.head.process.wait(5)

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
