"""An emulated controller for each module, reset before each test, and an armed arm connected to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.dashboard import Dashboard
from robot.drivers.ur10.driver_config import ArmConfig
from tests.helpers.live import Faults, until, ur_emulator

HOME = ArmConfig().placing.tcp_from_pose(np.array([0.63, 0.45, 0.0]))
AWAY = ArmConfig().placing.tcp_from_pose(np.array([0.93, 0.45, 0.0]))  # 6 s away


def settings(host: str, **others: Any) -> ArmConfig:
    """Settings with long time-outs: emulator and tests share a busy machine."""
    patient = {"stale": 30.0, "heartbeat": 30.0, "watchdog_hz": 0.05, "connect": 60.0, "patience": 60.0}
    return ArmConfig(host=host, **{**patient, **others})


class Bench:
    """Emulators at one address, one at a time."""

    def __init__(self, host: str) -> None:
        self.host = host
        self._stack = ExitStack()
        self._faults: Faults | None = None

    def controller(self) -> Faults:
        """A running emulator without faults, with its tool at HOME."""
        if self._faults is None or self._faults.process.poll() is not None:
            self._stack.close()
            self._faults = self._stack.enter_context(ur_emulator(self.host, HOME))
        faults = self._faults
        faults(do="clear")
        faults(do="wall")
        with Dashboard(self.host) as dashboard:
            dashboard.stop()
            if faults.state()["mode"] != "RUNNING":
                dashboard.ask("power on")
                dashboard.ask("brake release")
        until(lambda: not faults.state()["moving"])
        faults(do="place", tcp=HOME.tolist())
        return faults

    def close(self) -> None:
        self._stack.close()


@pytest.fixture(scope="module")
def bench(loopback: str) -> Iterator[Bench]:
    bench = Bench(loopback)
    yield bench
    bench.close()


@pytest.fixture
def controller(bench: Bench) -> Faults:
    """The emulated controller."""
    return bench.controller()


@pytest.fixture
def arm(controller: Faults) -> Iterator[Arm]:
    """An armed arm."""
    with Arm(settings(controller.host)) as arm:
        arm.start()
        yield arm


@pytest.fixture
def alert_arm(controller: Faults) -> Iterator[Arm]:
    """An armed arm that counts as lost after 1 s without a state."""
    with Arm(settings(controller.host, stale=1.0)) as arm:
        arm.start()
        yield arm
