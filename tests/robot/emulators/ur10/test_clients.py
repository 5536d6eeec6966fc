"""The real client libraries against the emulator, or against a real controller.

`RATSLAM_UR_HOST=192.168.56.101 pytest tests/robot/emulators/ur10/test_clients.py` runs the tests without
faults on that controller (or the vendor's simulator). They move the tool 20 mm upwards from its present
pose: leave it room.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.helpers.live import ROOT, Faults, until, ur_emulator

REAL = os.environ.get("RATSLAM_UR_HOST", "")
START = (0.6, 0.0, 0.3, math.pi, 0.0, 0.0)
WAIT = 15.0  # time limit for the exit of a client, s

pytestmark = pytest.mark.skipif(importlib.util.find_spec("rtde_receive") is None, reason="needs ur_rtde")
emulated = pytest.mark.skipif(bool(REAL), reason="needs an emulated controller")


class Bench:
    """Emulators at one address, one at a time."""

    def __init__(self, host: str) -> None:
        self.host = host
        self.faults: Faults | None = None
        self._stack = ExitStack()

    def fresh(self, *arguments: str) -> Faults:
        """Starts a new emulator without faults."""
        self.close()
        self.faults = self._stack.enter_context(ur_emulator(self.host, START, *arguments))
        return self.faults

    def close(self) -> None:
        self._stack.close()
        self.faults = None


@pytest.fixture(scope="module")
def bench(loopback: str) -> Iterator[Bench]:
    bench = Bench(loopback)
    yield bench
    bench.close()


@pytest.fixture
def faults(bench: Bench) -> Faults:
    """The present emulator with its faults cleared, or a new one if it has ended."""
    if bench.faults is None or bench.faults.process.poll() is not None:
        return bench.fresh()
    bench.faults(do="clear")
    return bench.faults


class Client:
    """A process with the client libraries, until the end of the block."""

    def __init__(self, host: str) -> None:
        command = [sys.executable, "-m", "tests.robot.emulators.ur10.client", host]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, cwd=ROOT, text=True, stdin=pipe, stdout=pipe, bufsize=1)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *error: object) -> None:
        self.process.kill()
        self.process.communicate()

    def call(self, part: str, name: str, *arguments: Any, repeat: bool = False) -> Any:
        """The result of a method of a library's interface."""
        self.process.stdin.write(json.dumps([part, name, arguments, repeat]) + "\n")
        return json.loads(self.process.stdout.readline())

    def control(self, name: str, *arguments: Any) -> Any:
        return self.call("control", name, *arguments)

    def receive(self, name: str) -> Any:
        return self.call("receive", name)

    def pose(self) -> list[float]:
        pose: list[float] = self.receive("getActualTCPPose")
        return pose


def control_error(host: str) -> str:
    """The library's error when control is refused; "" if it is granted."""
    with Client(host) as client:
        found = client.control("isConnected")
        return "" if found is True else str(found["error"])


VERSIONS = [
    ("125", "3.4"),
    pytest.param("125", "3.15.8", marks=pytest.mark.soak),
    ("500", "5.11"),
    pytest.param("500", "5.23", marks=pytest.mark.soak),
]


@emulated
@pytest.mark.parametrize(("hz", "polyscope"), VERSIONS)
def test_all_four_clients_of_ur_rtde_work_with_every_version(bench: Bench, hz: str, polyscope: str) -> None:
    faults = bench.fresh("--hz", hz, "--polyscope", polyscope)
    faults(do="remote", on=False)  # only an e-Series requires remote control
    assert ("remote control" in control_error(bench.host)) == (hz == "500")
    faults(do="remote", on=True)
    with Client(bench.host) as client:
        assert all(client.call(part, "isConnected") for part in ("receive", "control", "io"))
        client.call("dashboard", "connect")
        start, began = client.receive("getTimestamp"), time.monotonic()
        assert client.control("isProgramRunning")
        assert client.call("dashboard", "robotmode") == "Robotmode: RUNNING"
        assert polyscope in client.call("dashboard", "polyscopeVersion")
        assert [client.receive(f"getSafety{name}") for name in ("Mode", "StatusBits")] == [1, 1]
        pose = client.pose()
        assert client.control("isPoseWithinSafetyLimits", pose)
        assert not client.control("isPoseWithinSafetyLimits", [5.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        client.call("io", "setSpeedSlider", 0.25)
        until(lambda: client.receive("getTargetSpeedFraction") == pytest.approx(0.25), "the slider is set")
        client.control("setTcp", [0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
        until(lambda: pose[2] - client.pose()[2] == pytest.approx(0.1, abs=1e-9), "the tool is lowered")

        def rate() -> float:
            return (client.receive("getTimestamp") - start) / (time.monotonic() - began)

        # A state can be a second old on a busy machine.
        until(lambda: time.monotonic() > began + 0.5 and rate() == pytest.approx(1.0, abs=0.1), "a clock")
    bench.close()


def test_moves_and_stops(request: pytest.FixtureRequest) -> None:
    host = REAL or request.getfixturevalue("faults").host
    with Client(host) as client:
        home = client.pose()
        goal = [*home[:2], home[2] + 0.02, *home[3:]]

        def operation(name: str = "operationId") -> Any:
            return client.control(f"getAsyncOperationProgressEx.{name}")

        def off(pose: list[float]) -> float:
            return math.dist(client.pose()[:3], pose[:3])

        before = operation()
        client.control("moveL", goal, 0.01, 0.5, True)
        until(lambda: operation() != before, "the move is known")
        time.sleep(0.3)
        under_way = off(home)
        client.control("stopL", 2.0)
        until(
            lambda: not any(client.receive("getActualTCPSpeed")) and not operation("isAsyncOperationRunning")
        )
        assert 0.001 < under_way <= off(home) < 0.015
        for there in (goal, home):
            assert client.control("moveL", there, 0.1, 1.0)
            until(lambda there=there: off(there) < 1e-5, "arrival")


@pytest.mark.parametrize("watched", [True, False])
@emulated
def test_the_arm_of_a_killed_client_is_stopped_only_by_the_watchdog(faults: Faults, watched: bool) -> None:
    before = faults.state()
    with Client(faults.host) as client:
        x, y, *rest = client.pose()
        if watched:
            client.control("setWatchdog", 10)
        client.control("moveL", [x, y + 0.3, *rest], 0.01, 0.5, True)
        client.call("control", "kickWatchdog" if watched else "isProgramRunning", repeat=True)
        until(lambda: faults.state()["speed"][1] == pytest.approx(0.01), "the arm moves")
        time.sleep(0.3)
        assert faults.state()["moving"]
        client.process.send_signal(signal.SIGKILL)
        client.process.wait(WAIT)
    if watched:
        until(lambda: not faults.state()["moving"], "the arm stands")
    else:
        time.sleep(0.5)
        assert faults.state()["moving"]
    after = faults.state()
    assert after["watchdog_stops"] - before["watchdog_stops"] == watched
    assert after["targets"][-1]["speed"] == 0.01


SIGNS: list[tuple[dict[str, Any], Callable[[Client], bool]]] = [
    ({"do": "nan"}, lambda client: all(map(math.isnan, client.pose()))),
    ({"do": "freeze"}, lambda client: went(client) < 0.1),
    ({"do": "stall", "seconds": 1.0}, lambda client: went(client) < 0.1),
    ({"do": "protective"}, lambda client: client.receive("getSafetyStatusBits") == 1 << 10 | 1 << 2),
    ({"do": "safeguard"}, lambda client: client.receive("getSafetyStatusBits") == 1 << 10 | 1 << 4),
    ({"do": "slider", "fraction": 0.1}, lambda client: client.receive("getTargetSpeedFraction") < 0.101),
    (
        {"do": "wall", "z": 0.31, "solid": -1, "stiffness": 1e3},
        lambda client: client.receive("getActualTCPForce")[2] == pytest.approx(10),
    ),
]


def went(client: Client) -> float:
    """How far the controller's clock goes in 0.15 s."""
    start = client.receive("getTimestamp")
    time.sleep(0.15)
    return float(client.receive("getTimestamp") - start)


@emulated
def test_a_fault_is_seen_by_the_client_until_it_is_cleared(faults: Faults) -> None:
    faults(do="place", tcp=START)
    faults(do="wall")
    with Client(faults.host) as client:
        for fault, sign in SIGNS:
            assert not sign(client), fault
            faults(**fault)
            until(lambda sign=sign: sign(client), str(fault))
            assert client.receive("isConnected")
            faults(do="clear")
            faults(do="wall")
            until(lambda sign=sign: not sign(client), f"{fault} is cleared")
        faults(do="close")
        until(lambda: not client.receive("isConnected"), "the connection is closed")


@emulated
def test_an_invalid_request_on_the_fault_port_is_refused(faults: Faults) -> None:
    for request in (
        {"do": "juggle"},
        {"do": "stall"},
        {"do": "place", "tcp": [1]},
        {"do": "place", "tcp": [9.0] * 6},
    ):
        with pytest.raises(AssertionError):
            faults(**request)
    assert faults.state()["tcp"][:3] == pytest.approx(START[:3], abs=0.05)
