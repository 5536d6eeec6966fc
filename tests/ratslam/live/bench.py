"""Emulated robots, each in processes of its own, and quick sessions on them."""

import json
import re
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from robot.drivers.ur10.dashboard import Dashboard
from robot.drivers.ur10.driver_config import BaseTransformConfig
from robot.emulators.head.emulator_config import HeadEmulatorConfig
from robot.recordings.mcap_reader import Recording
from tests.helpers.live import HEAD_FAULTS, PATIENCE, Faults, emulator, started, until, ur_emulator
from tests.ratslam.live.live_session import Moment, RecordedData, Session, SessionServer, raise_priority

LEGS = tuple((0.63 + 0.07 * x, 0.45 + 0.02 * (x % 2), 0.0) for x in (0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0))
"""Route of quick sessions: legs of 1.6 s."""
START = BaseTransformConfig().tcp_from_pose(np.array(LEGS[0]), 0.005)
HIGH = BaseTransformConfig(z=BaseTransformConfig().z - 0.3)
"""Pose of the map for the emulated head in quick sessions, too low for its whiskers to touch walls."""
LOST = 1.5
"""s of a recording that may be lost on a busy machine."""
STRICT = 0.4
"""The same on an idle machine, where soak tests run; also s until an arm is at rest."""
PLAN = {"arena": {"side": 1.25}, "wheels": {"noise": "bias"}, "seed": 7}
"""World and behaviour of a Create's sessions: the robot drives ahead for 15 s, then touches a wall."""
SLACK = {"patience": 5.0, "silence": 2.0, "replug": 20.0, "stuck": 0.8}
"""Time limits of a Create for a busy machine, and a short one for the bumper."""


class Bench:
    """An emulated arm and head at an address, by their faults; started again after they ended."""

    arm: Faults
    head: Faults

    def __init__(self, host: str, server: SessionServer, folder: Path) -> None:
        self.host, self._server, self._folder = host, server, folder
        self._arm, self._head = ExitStack(), ExitStack()
        self.starved = 0  # number of stops by the controller's watchdog before the test

    def ready(self) -> None:
        """Clears the faults of both devices and places the tool at `START`."""
        if not self._runs("arm"):
            self._arm.close()
            self.arm = self._arm.enter_context(ur_emulator(self.host, START))
        if not self._runs("head"):
            self._head.close()
            self.head = self._head.enter_context(self._a_head())
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

    def session(
        self, mapper: float | None = 0.0, order: dict[str, Any] | None = None, **settings: Any
    ) -> AbstractContextManager[Session]:
        """A quick session with settings of the section `live`, and a section `touch`, started; see
        `SessionServer.session`."""
        touch = {"touch": settings.pop("touch")} if "touch" in settings else {}
        sections = {"live": self.quick(**settings)} | touch
        return self._server.session(sections, mapper=mapper, **order or {})

    @contextmanager
    def in_motion(self, **settings: Any) -> Iterator[Session]:
        """A quick session after two whisks, with the arm at full speed."""
        with self.session(**settings) as session:
            session.wait_for("armed")
            session.until(lambda: whisk_count(session) >= 2 and self.moves(), "two whisks and a moving arm")
            yield session

    def quick(self, **settings: Any) -> dict[str, Any]:
        """The section `live` of a session of a few seconds, with time-outs for a busy machine."""
        usual: dict[str, Any] = {"waypoints": LEGS, "lift": 0.01, "residual": 1.0, "room": 0.0}
        usual |= {"grace": 1.0, "budget": PATIENCE}
        patience = {"patience": PATIENCE, "connect": PATIENCE}
        parts: dict[str, dict[str, Any]] = {
            "arm": {"host": self.host, "stale": 30.0, "heartbeat": 30.0, "watchdog_hz": 0.05} | patience,
            "head": {"address": self.host, "patience": PATIENCE, "silence": 20.0},
            "plan": {
                "whisking": {"rate": 4.0}, "calibration": {"min_duration": 1.0}, "motion": {"speed": 0.05}
            },
        }  # fmt: skip
        return usual | {name: value | settings.pop(name, {}) for name, value in parts.items()} | settings

    def moment(self) -> Moment:
        return Moment(self.arm.state()["time"], self.head.state()["sequence"])

    def still(self) -> bool:
        return not self.arm.state()["moving"]

    def moves(self) -> bool:
        return float(np.linalg.norm(self.arm.state()["speed"][:3])) > 0.045

    def stands(self, within: float = PATIENCE) -> None:
        """Checks that the controller's program has ended, so that nothing can move the arm, which stands."""
        if self.arm.process.poll() is not None:
            return  # the controller is gone
        until(lambda: self.arm.state()["runtime"] == "STOPPED" and self.still(), "the arm stands", within)
        place = self.arm.state()["tcp"]
        time.sleep(0.1)
        assert self.arm.state()["tcp"] == place

    def ended(
        self, session: Session, outcome: str, at: Moment | None = None
    ) -> tuple[dict[str, Any], RecordedData]:
        """The report and the recording of a session that ended so by itself, nothing lost up to a moment."""
        report = session.ends(outcome)
        self.stands()
        recorded = session.recorded()
        assert not recorded.broken
        assert at is None or recorded.lost(at) <= LOST
        return report, recorded

    def replace_head(self) -> None:
        """Ends the emulated head, whose fault cannot be cleared; the next test gets a new one."""
        self.head.process.kill()
        self.head.process.wait(PATIENCE)

    def close(self) -> None:
        self._arm.close()
        self._head.close()

    def _runs(self, name: str) -> bool:
        return hasattr(self, name) and getattr(self, name).process.poll() is None

    def _a_head(self) -> AbstractContextManager[Faults]:
        config = self._folder / "head.json"
        config.write_text(HeadEmulatorConfig(host=self.host, arm=self.host, placing=HIGH).model_dump_json())
        return emulator("robot.emulators.head", HEAD_FAULTS, self.host, "--config", str(config))


def whisk_count(session: Session) -> int:
    """Number of whisks recorded, by the progress bar."""
    return max(map(int, re.findall(r"(\d+)/\d+ \[", session.output())), default=0)


class CreateBench:
    """An emulated Create at an address: its serial port, a link, and faults of its whiskers' bridge."""

    whiskers: Faults
    model = "create1"

    def __init__(self, host: str, server: SessionServer, folder: Path) -> None:
        self.host, self.port, self._server, self._stack = host, folder / "create.tty", server, ExitStack()

    def ready(self, model: str = "create1") -> None:
        """Clears the faults of a robot of this model and plugs it in."""
        if not self.runs() or model != self.model:
            self.close()
            self.model = model
            world = {"arena": PLAN["arena"], "wheels": PLAN["wheels"], "bridge": {"host": self.host}}
            robot = {"port": str(self.port), "seed": PLAN["seed"], "firmware": {"model": model}}
            config = json.dumps(robot | {"world": world})
            command = ["-m", "robot.emulators.create", "--config", config]
            self.whiskers = self._stack.enter_context(started(command, HEAD_FAULTS, self.host))
        self.robot("clear")
        self.robot("plug")

    def runs(self) -> bool:
        return hasattr(self, "whiskers") and self.whiskers.process.poll() is None

    def close(self) -> None:
        self._stack.close()
        self.port.unlink(missing_ok=True)  # its terminal's name is free for the next emulator

    def robot(self, do: str, **request: Any) -> dict[str, Any]:
        return self.whiskers(device="create", do=do, **request)

    def state(self) -> dict[str, Any]:
        return self.robot("state")

    def rolls(self) -> bool:
        return any(self.state()["wheels"])

    def stopped_after(self, moment: float = 0.0) -> float:
        """Time from a moment (s, host) until the wheels stood for good, s, by the robot's own log."""
        state = until(lambda: (found := self.state())["wheels"] == [0, 0] and found, "the wheels stand")
        moments = [state["began"] + at for at, right, left in state["speeds"] if not (right or left)]
        return max(0.0, moments[-1] - moment)

    def live(self, silence: float = 5.0, **settings: Any) -> dict[str, Any]:
        head = {"address": self.host, "silence": silence}
        create = {"port": str(self.port), "plan": {**PLAN, "minutes": 1}, **settings}
        return {"head": head, "create": create, "room": 0.0, "residual": 1.0}

    def session(
        self, live: dict[str, Any], mapper: float | None = None, rate_check: bool = False, **settings: Any
    ) -> AbstractContextManager[Session]:
        """A session with the method `grid`, started; see `SessionServer.session`."""
        config = {"live": live, "backend": "grid", **settings}
        return self._server.session(config, mapper=mapper, rate_check=rate_check)

    @contextmanager
    def rolling(self) -> Iterator[Session]:
        """A quick session with a stub mapper, when the robot has driven two steps and rolls."""
        before = self.state()["travelled"]
        with self.session(self.live(**SLACK), mapper=0.0) as session:
            session.until(lambda: self.rolls() and self.state()["travelled"] > before + 0.05, "two steps")
            yield session

    def ended(self, session: Session, outcome: str) -> Recording:
        """The recording of a session that ended by itself with an outcome and nothing lost."""
        report = session.ends(outcome)
        self.stopped_after()
        recording = Recording(session.directory / "session.mcap")
        assert not recording.truncated
        assert recording.length == report["reports"]
        return recording
