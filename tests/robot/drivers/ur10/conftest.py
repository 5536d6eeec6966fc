"""An emulated controller for each module, reset before each test, and an armed arm connected to it."""

from contextlib import ExitStack

import numpy as np
import pytest

from robot.drivers.ur10.arm import Arm
from robot.drivers.ur10.dashboard import Dashboard
from robot.drivers.ur10.driver_config import ArmConfig
from tests.helpers.live import until, ur_emulator

HOME = ArmConfig().placing.tcp_from_pose(np.array([0.63, 0.45, 0.0]))
AWAY = ArmConfig().placing.tcp_from_pose(np.array([0.93, 0.45, 0.0]))  # 6 s away


def settings(host, **others):
    """Settings with long time-outs: emulator and tests share a busy machine."""
    patient = {"stale": 30.0, "heartbeat": 30.0, "watchdog_hz": 0.05, "connect": 60.0, "patience": 60.0}
    return ArmConfig(host=host, **{**patient, **others})


@pytest.fixture(scope="module")
def bench(loopback):
    """Gives the running emulator, a new one where the last has ended."""
    started = []
    with ExitStack() as stack:

        def running():
            if not started or started[-1].process.poll() is not None:
                stack.close()
                started.append(stack.enter_context(ur_emulator(loopback, HOME)))
            return started[-1]

        yield running


@pytest.fixture
def controller(bench):
    """The emulated controller, without faults and with its tool at HOME."""
    faults = bench()
    faults(do="clear")
    faults(do="wall")
    with Dashboard(faults.host) as dashboard:
        dashboard.stop()
        if faults.state()["mode"] != "RUNNING":
            dashboard.ask("power on")
            dashboard.ask("brake release")
    until(lambda: not faults.state()["moving"])
    faults(do="place", tcp=HOME.tolist())
    return faults


@pytest.fixture
def arm(controller):
    with Arm(settings(controller.host)) as arm:
        arm.start()
        yield arm
