"""The emulated head behind the system's real libusb, with Debian's umockdev in place of the kernel."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from robot.emulators.head.emulator_config import HeadEmulatorConfig
from tests.helpers.live import ROOT
from tests.robot.emulators.head.heads import running

SYSTEM = "/usr/bin/python3"
"""The interpreter of Debian's packages."""
NEEDED = "apt-get install umockdev gir1.2-umockdev-1.0 python3-gi libusb-1.0-0"


def missing_packages() -> str:
    """The missing package of this machine; '' if none."""
    if shutil.which("umockdev-wrapper") is None or not Path(SYSTEM).exists():
        return "no umockdev"
    check = "import ctypes, gi; gi.require_version('UMockdev', '1.0'); ctypes.CDLL('libusb-1.0.so.0')"
    done = subprocess.run([SYSTEM, "-c", check], capture_output=True, text=True, timeout=20, check=False)
    return done.stderr.strip().splitlines()[-1] if done.returncode else ""


def run_on_testbed(host: str, *program: str) -> tuple[int, str, str]:
    """Runs a program with a head on its USB; returns its exit code, output and errors."""
    words = ["umockdev-wrapper", SYSTEM, "-m", "tests.robot.emulators.umock", "--host", host, "--", *program]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        words, cwd=ROOT, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    ) as process:
        try:
            output, errors = process.communicate(timeout=60)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    return process.returncode, output, errors


@pytest.fixture(scope="module", autouse=True)
def _needs_umockdev() -> None:
    pytest.importorskip("usb.core", reason="pyusb is not installed: pip install 'ratslam[live]'")
    if found := missing_packages():
        pytest.skip(f"{found}: {NEEDED}")


def test_libusb_reads_frames_and_reports_stalls_and_unplugging(tmp_path: Path, loopback: str) -> None:
    host = f"127.0.2.{loopback.rsplit('.', 1)[1]}"
    with running(HeadEmulatorConfig(host=host, path={"explore": 5}), tmp_path) as head:
        code, output, errors = run_on_testbed(
            host, sys.executable, "-m", "tests.robot.emulators.umock.client", host
        )
        assert code == 0, errors
        seen = json.loads(output)
        assert seen["whiskers"] == 18
        assert seen["frames"] >= 3000
        assert seen["stalls"] == 1  # cleared by then
        assert (seen["counts"]["missing"], seen["counts"]["bad"], seen["counts"]["overruns"]) == (0, 0, 0)
        assert seen["idle"][0] == 0
        assert seen["idle"][1] >= 0.2
        assert seen["gone"]
        assert seen["absent"]
        assert seen["again"] >= 1000
        assert seen["missing"] == 0
        assert head(do="counts")["lost"] == 0


def test_the_exit_code_is_that_of_the_program(tmp_path: Path, loopback: str) -> None:
    """Without a head at the address, the bus is empty."""
    program = "import usb.core, sys; sys.exit(7 if usb.core.find() is None else 1)"
    assert run_on_testbed("127.0.3.1", sys.executable, "-c", program)[0] == 7
