"""The real client libraries against the emulator, or against a real controller.

`RATSLAM_UR_HOST=192.168.56.101 pytest tests/robot/emulators/ur10/test_clients.py` runs the test of moves on
that controller. It moves the tool 20 mm upwards from its present pose: leave it room.

`python -m tests.robot.emulators.ur10.test_clients HOST` has the libraries in its own process; they may crash.
Each line of input is a call as JSON: the library's part (`PARTS`), the method, its arguments; `a.b`
calls b of the result of a. It prints the result as JSON, or {"error": text}.
"""

import importlib
import importlib.util
import json
import math
import os
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext

import pytest

from tests.helpers.live import ROOT, until, ur_emulator

REAL = os.environ.get("RATSLAM_UR_HOST", "")
START = (0.6, 0.0, 0.3, math.pi, 0.0, 0.0)
PARTS = {
    "control": ("rtde_control", "RTDEControlInterface"),
    "receive": ("rtde_receive", "RTDEReceiveInterface"),
    "io": ("rtde_io", "RTDEIOInterface"),
    "dashboard": ("dashboard_client", "DashboardClient"),
}
pytestmark = pytest.mark.skipif(importlib.util.find_spec("rtde_receive") is None, reason="needs ur_rtde")


@contextmanager
def client(host):
    """A process with the client libraries; gives a function that calls them."""
    words, pipe = [sys.executable, "-m", "tests.robot.emulators.ur10.test_clients", host], subprocess.PIPE
    process = subprocess.Popen(words, cwd=ROOT, text=True, stdin=pipe, stdout=pipe, bufsize=1)

    def call(part, name, *arguments):
        process.stdin.write(json.dumps([part, name, arguments]) + "\n")
        return json.loads(process.stdout.readline())

    try:
        yield call
    finally:
        process.kill()
        process.communicate()


SOAK = pytest.mark.soak
VERSIONS = [("125", "3.4"), pytest.param("125", "3.15.8", marks=SOAK), ("500", "5.11"),
            pytest.param("500", "5.23", marks=SOAK)]  # fmt: skip


@pytest.mark.skipif(bool(REAL), reason="needs an emulated controller")
@pytest.mark.parametrize(("hz", "polyscope"), VERSIONS)
def test_all_four_clients_of_ur_rtde_work_with_every_version(loopback, hz, polyscope):
    with ur_emulator(loopback, START, "--hz", hz, "--polyscope", polyscope) as faults:
        faults(do="remote", on=False)  # only an e-Series requires remote control
        with client(loopback) as call:
            assert ("remote control" in str(call("control", "isConnected"))) == (hz == "500")
        faults(do="remote", on=True)
        with client(loopback) as call:
            assert all(call(part, "isConnected") is True for part in ("receive", "control", "io"))
            call("dashboard", "connect")
            start, began = call("receive", "getTimestamp"), time.monotonic()
            assert call("control", "isProgramRunning")
            assert call("dashboard", "robotmode") == "Robotmode: RUNNING"
            assert polyscope in call("dashboard", "polyscopeVersion")
            assert [call("receive", f"getSafety{name}") for name in ("Mode", "StatusBits")] == [1, 1]
            pose = call("receive", "getActualTCPPose")
            assert call("control", "isPoseWithinSafetyLimits", pose)
            assert not call("control", "isPoseWithinSafetyLimits", [5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
            call("io", "setSpeedSlider", 0.25)
            until(lambda: call("receive", "getTargetSpeedFraction") == pytest.approx(0.25))
            call("control", "setTcp", [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
            lower = pytest.approx(pose[2] - 0.1, abs=1e-9)
            until(lambda: call("receive", "getActualTCPPose")[2] == lower, "the tool is lowered")

            def rate():
                return (call("receive", "getTimestamp") - start) / (time.monotonic() - began)

            # A state can be a second old on a busy machine.
            until(lambda: time.monotonic() > began + 0.5 and rate() == pytest.approx(1.0, abs=0.1), "a clock")
        for request in ({"do": "juggle"}, {"do": "stall"}, {"do": "place", "tcp": [1]},
                        {"do": "place", "tcp": [9.0] * 6}):  # fmt: skip
            with pytest.raises(AssertionError):
                faults(**request)
        assert faults.state()["tcp"][:2] == pytest.approx(START[:2], abs=0.05)


def test_moves_and_stops(loopback):
    with nullcontext() if REAL else ur_emulator(loopback, START), client(REAL or loopback) as call:
        home = call("receive", "getActualTCPPose")
        goal = [*home[:2], home[2] + 0.02, *home[3:]]

        def operation(name="operationId"):
            return call("control", f"getAsyncOperationProgressEx.{name}")

        def off(pose):
            return math.dist(call("receive", "getActualTCPPose")[:3], pose[:3])

        def stands():
            return not any(call("receive", "getActualTCPSpeed")) and not operation("isAsyncOperationRunning")

        before = operation()
        call("control", "moveL", goal, 0.01, 0.5, True)
        until(lambda: operation() != before, "the move is known")
        time.sleep(0.3)
        under_way = off(home)
        call("control", "stopL", 2.0)
        until(stands)
        assert 0.001 < under_way <= off(home) < 0.015
        for there in (goal, home):
            assert call("control", "moveL", there, 0.1, 1.0)
            until(lambda there=there: off(there) < 1e-5, "arrival")


def main(host):
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # the libraries print
    made = {}
    for line in sys.stdin:
        part, name, arguments = json.loads(line)
        try:
            if part not in made:
                module, kind = PARTS[part]
                made[part] = getattr(importlib.import_module(module), kind)(host)
            first, *others = name.split(".")
            found = getattr(made[part], first)(*arguments)
            for other in others:
                found = getattr(found, other)()
        except Exception as error:  # the test checks the message
            found = {"error": str(error)}
        print(json.dumps(found), file=answers, flush=True)


if __name__ == "__main__":
    main(sys.argv[1])
