"""A session that is killed or hangs during a motion: the arm stops, and no process or memory remains."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.live import ROOT, Faults, until
from tests.robot.drivers.ur10.conftest import AWAY

SESSION = """
import sys, time
from robot.drivers.ur10.arm import Arm
from tests.robot.drivers.ur10.conftest import settings
arm = Arm(settings(sys.argv[1], heartbeat=1.0, watchdog_hz=2.0))
arm.start()
arm.move([float(number) for number in sys.argv[2:]])
print(arm.process.pid, flush=True)
time.sleep(600)
"""


def runs(pid: int) -> bool:
    """Whether a process runs; a zombie does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize("what", ["killed", "hangs", "killed with the arm's process"])
def test_the_arm_stops_when_the_session_ends_or_hangs(controller: Faults, what: str) -> None:
    target = [repr(float(value)) for value in AWAY]
    session = subprocess.Popen(
        [sys.executable, "-c", SESSION, controller.host, *target],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert session.stdout is not None
        pid = session.stdout.readline()
        shared = shared_memory(session.pid)
        until(lambda: controller.state()["speed"][0] > 0.049, "the arm moves")
        bites = controller.state()["watchdog_stops"]
        if what == "killed with the arm's process":
            os.kill(int(pid), signal.SIGSTOP)  # so that it does not detect the end first
        session.send_signal(signal.SIGSTOP if what == "hangs" else signal.SIGKILL)
        if what == "killed with the arm's process":
            os.kill(int(pid), signal.SIGKILL)
        until(lambda: not controller.state()["moving"], "a standstill")
        place = controller.state()["tcp"]
        assert place[0] < AWAY[0] - 1e-3, "the arm reached its target"
        until(lambda: not runs(int(pid)), "the arm's process ends")
        until(lambda: controller.state()["runtime"] == "STOPPED", "the controller's program ends")
        assert controller.state()["tcp"] == place
        if what == "killed with the arm's process":
            assert controller.state()["watchdog_stops"] == bites + 1
        if what != "hangs":
            session.wait(30)
            assert not [name for name in shared if Path(name).exists()], "shared memory remains"
    finally:
        session.kill()
        session.wait(30)
        assert session.stdout is not None
        session.stdout.close()


def shared_memory(pid: int) -> list[str]:
    """Files in /dev/shm that a process has mapped."""
    lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    return [line.split(maxsplit=5)[5] for line in lines if "/dev/shm/" in line]
