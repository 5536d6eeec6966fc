"""The emulated head behind the system's real libusb, with Debian's umockdev in place of the kernel."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from robot.drivers.head.decoder import Decoder
from robot.drivers.head.device import Disconnected, HeadIdentity, Stalled, open_bridge
from robot.drivers.head.driver_config import PORT
from robot.drivers.head.usb_protocol import KEEP_ALIVE, Request
from robot.emulators.head.emulator_config import CONTROL_PORT, HeadEmulatorConfig
from tests.helpers.live import ROOT, Faults, until
from tests.robot.emulators.head.heads import drive, running

SYSTEM = "/usr/bin/python3"
"""The interpreter of Debian's packages."""
NEEDED = "apt-get install umockdev gir1.2-umockdev-1.0 python3-gi libusb-1.0-0"
MODULE = "tests.robot.emulators.umock"


def run_on_testbed(host, *program):
    """Runs a program with a head on its USB; returns its exit code, output and errors."""
    words = ["umockdev-wrapper", SYSTEM, "-m", MODULE, host, str(PORT), sys.executable, *program]
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
def _needs_umockdev():
    pytest.importorskip("usb.core", reason="pyusb is not installed: pip install 'ratslam[live]'")
    check = "import ctypes, gi; gi.require_version('UMockdev', '1.0'); ctypes.CDLL('libusb-1.0.so.0')"
    if shutil.which("umockdev-wrapper") is None or subprocess.run([SYSTEM, "-c", check]).returncode:
        pytest.skip(NEEDED)


def test_libusb_reads_frames_and_reports_stalls_and_unplugging(tmp_path, loopback):
    host = f"127.0.2.{loopback.rsplit('.', 1)[1]}"
    with running(HeadEmulatorConfig(host=host, path={"explore": 5}), tmp_path) as head:
        code, output, errors = run_on_testbed(host, "-m", f"{MODULE}.test_umock", host)
        assert code == 0, errors
        seen = json.loads(output)
        assert (seen["whiskers"], seen["stalls"]) == (18, 1)  # cleared by then
        assert seen["frames"] >= 3000
        assert (seen["counts"]["missing"], seen["counts"]["bad"], seen["counts"]["overruns"]) == (0, 0, 0)
        assert seen["idle"][0] == 0
        assert seen["idle"][1] >= 0.2
        assert seen["again"] >= 1000
        assert (seen["missing"], head(do="counts")["lost"]) == (0, 0)


def test_the_exit_code_is_that_of_the_program():
    """Without a head at the address, the bus is empty."""
    program = "import usb.core, sys; sys.exit(7 if usb.core.find() is None else 1)"
    assert run_on_testbed("127.0.3.1", "-c", program)[0] == 7


def host_of_the_head(host):
    """The program on the test bed: reads frames through a stall, a stop, and unplugging and plugging in;
    prints JSON."""
    # The libusb of `libusb-package` gets unplug events from the kernel, not from umockdev.
    sys.modules["libusb_package"] = None
    seen = {}
    faults = Faults(None, host, CONTROL_PORT)
    bridge, decoder = open_bridge("usb"), Decoder(18, 3)
    seen["whiskers"] = HeadIdentity.read(bridge).whiskers
    bridge.request(Request.START)
    bridge.write(drive().pack())
    seen["frames"] = read(bridge, decoder, 3000)

    faults(do="stall")
    seen["stalls"] = 0
    for _ in range(3):
        try:
            decoder.feed(bridge.read(4096, 0.5))
        except Stalled:
            seen["stalls"] += 1
    read(bridge, decoder, 500)
    seen["counts"] = decoder.counts._asdict()

    bridge.request(Request.STOP)
    began = time.monotonic()
    seen["idle"] = len(bridge.read(4096, 0.2)), time.monotonic() - began
    bridge.request(Request.START)

    faults(do="unplug")
    until(lambda: ends(lambda: bridge.read(4096, 0.5), Disconnected), "a read ends", 5.0)
    bridge.close()
    until(lambda: ends(lambda: open_bridge("usb").close(), Disconnected), "the head is absent", 5.0)
    faults(do="plug")
    until(lambda: not ends(lambda: open_bridge("usb").close(), Disconnected, Stalled), "it is back", 5.0)
    bridge, decoder = open_bridge("usb"), Decoder(18, 3)
    bridge.request(Request.START)
    seen["again"] = read(bridge, decoder, 1000)
    seen["missing"] = decoder.counts.missing
    bridge.close()
    print(json.dumps(seen))


def read(bridge, decoder, frames):
    """Reads at least `frames` frames, for at most 10 s; returns their number."""
    end, got = time.monotonic() + 10.0, 0
    while got < frames and time.monotonic() < end:
        got += len(decoder.feed(bridge.read(4096, 0.5)).values)
        bridge.write(KEEP_ALIVE.pack())
    return got


def ends(action, *kinds):
    """Whether an action ends with such an error; a stall may come while the device is pulled out."""
    try:
        action()
    except kinds:
        return True
    except Stalled:
        pass
    return False


if __name__ == "__main__":
    host_of_the_head(sys.argv[1])
