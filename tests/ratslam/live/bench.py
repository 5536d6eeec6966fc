"""Emulated arm and head, each in a process of its own, and quick sessions on them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from robot.drivers.ur10.dashboard import Dashboard
from robot.drivers.ur10.driver_config import BaseTransformConfig
from robot.emulators.head.emulator_config import HeadEmulatorConfig
from tests.helpers.live import HEAD_FAULTS, PATIENCE, Faults, emulator, until, ur_emulator
from tests.ratslam.live.forked_process import raise_priority
from tests.ratslam.live.live_session import Session
from tests.ratslam.live.recorded_data import Moment
from tests.ratslam.live.server_process import SessionServer

LEGS = tuple((0.63 + 0.07 * x, 0.45 + 0.02 * (x % 2), 0.0) for x in (0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0))
"""Route of quick sessions: legs of 1.6 s."""
START = BaseTransformConfig().tcp_from_pose(np.array(LEGS[0]), 0.005)
HIGH = BaseTransformConfig(z=BaseTransformConfig().z - 0.3)
"""Pose of the map for the emulated head in quick sessions, too low for its whiskers to touch walls."""


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
        plan = {"whisking": {"rate": 4.0}, "calibration": {"min_duration": 1.0}, "motion": {"speed": 0.05}}
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
