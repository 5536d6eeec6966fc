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
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from robot.drivers.ur10.rtde_protocol import PoseListener
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

    def good(self) -> Faults:
        """The present emulator with its faults cleared, or a new one if it has ended."""
        if self.faults is None or self.faults.process.poll() is not None:
            return self.fresh()
        self.faults(do="clear")
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
    return bench.good()


@contextmanager
def client(host: str, scenario: str) -> Iterator[subprocess.Popen[str]]:
    """A client's process, until the end of the block."""
    command = [sys.executable, "-m", "tests.robot.emulators.ur10.client", host, scenario]
    process = subprocess.Popen(
        command, cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def wait_for_client(process: subprocess.Popen[str]) -> None:
    """Waits until a client prints "here"."""
    assert process.stdout is not None
    for line in process.stdout:
        if line.strip() == "here":
            return
    raise AssertionError(process.communicate()[1])


def resume(process: subprocess.Popen[str]) -> None:
    """Sends the line for which a client waits."""
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.flush()


def outcome(process: subprocess.Popen[str]) -> Any:
    """The result of a client, from its last line."""
    output, errors = process.communicate("\n", timeout=WAIT)
    assert process.returncode == 0, errors
    return json.loads(output.splitlines()[-1])


def run_scenario(host: str, scenario: str) -> Any:
    with client(host, scenario) as process:
        return outcome(process)


VERSIONS = [
    ("125", "3.4"),
    pytest.param("125", "3.15.8", marks=pytest.mark.soak),
    ("500", "5.11"),
    pytest.param("500", "5.23", marks=pytest.mark.soak),
]


@emulated
@pytest.mark.parametrize(("hz", "polyscope"), VERSIONS)
def test_all_four_clients_of_ur_rtde_work_with_every_version(bench: Bench, hz: str, polyscope: str) -> None:
    bench.fresh("--hz", hz, "--polyscope", polyscope)
    seen = run_scenario(bench.host, "all")
    assert seen["connected"] == [True] * 3
    assert seen["program"]
    assert seen["mode"] == "Robotmode: RUNNING"
    assert polyscope in seen["version"]
    assert seen["safety"] == [1, 1]
    assert seen["lowered"] == pytest.approx(0.1, abs=1e-9)
    assert seen["reachable"] == [True, False]
    assert seen["rate"] == pytest.approx(1.0, abs=0.1)
    bench.close()


def test_moves_and_stops(bench: Bench) -> None:
    if REAL:
        host = REAL
    else:
        bench.good()
        host = bench.host
    seen = run_scenario(host, "moves")
    assert seen["accepted"] == [True] * 2
    assert seen["seen"] == [True] * 3
    assert 0.001 < seen["under_way"] <= seen["stood"] < 0.015


@pytest.mark.parametrize("watched", [True, False])
@emulated
def test_the_arm_of_a_killed_client_is_stopped_only_by_the_watchdog(faults: Faults, watched: bool) -> None:
    before = faults.state()
    with client(faults.host, "drive watched" if watched else "drive") as process:
        wait_for_client(process)
        until(lambda: faults.state()["speed"][1] == pytest.approx(0.01), "the arm moves")
        time.sleep(0.3)
        assert faults.state()["moving"]
        process.send_signal(signal.SIGKILL)
        process.wait(WAIT)
    if watched:
        until(lambda: not faults.state()["moving"], "the arm stands")
    else:
        time.sleep(0.5)
        assert faults.state()["moving"]
    after = faults.state()
    assert after["watchdog_stops"] - before["watchdog_stops"] == watched
    assert after["targets"][-1]["speed"] == 0.01


@emulated
def test_a_malformed_package_aborts_the_client(faults: Faults) -> None:
    with client(faults.host, "watch") as process:
        wait_for_client(process)
        faults(do="malformed")
        process.communicate("\n", timeout=WAIT)
        assert process.returncode == -signal.SIGABRT


@emulated
@pytest.mark.soak
def test_a_long_stall_ends_a_controlling_client(faults: Faults) -> None:
    with client(faults.host, "solve") as process:
        wait_for_client(process)
        faults(do="stall", seconds=3.5)
        process.wait(WAIT)
        assert process.returncode < 0


@emulated
def test_the_state_rate_can_be_lowered(faults: Faults) -> None:
    def count_states() -> int:
        with PoseListener(faults.host) as poses:
            until(poses.latest)
            times = set()
            end = poses.latest().robot_time + 0.5
            while poses.latest().robot_time < end:
                times.add(poses.latest().robot_time)
                time.sleep(0.001)
        return len(times)

    faults(do="rate", hz=40)
    assert 15 <= count_states() <= 25
    faults(do="clear")
    assert count_states() > 30


@emulated
@pytest.mark.parametrize(
    ("fault", "sign"),
    [
        ({"do": "close"}, lambda seen: not seen["connected"]),
        ({"do": "nan"}, lambda seen: all(seen["nan"])),
        ({"do": "freeze"}, lambda seen: seen["went"] < 0.1),
        ({"do": "stall", "seconds": 1.0}, lambda seen: seen["connected"] and seen["went"] < 0.1),
        ({"do": "protective"}, lambda seen: seen["bits"] == 1 << 2 | 1 << 10),
        pytest.param(
            {"do": "safeguard"}, lambda seen: seen["bits"] == 1 << 4 | 1 << 10, marks=pytest.mark.soak
        ),
        ({"do": "slider", "fraction": 0.1}, lambda seen: seen["slider"] == pytest.approx(0.1)),
        (
            {"do": "wall", "z": 0.31, "solid": -1, "stiffness": 1e3},
            lambda seen: seen["force"][2] == pytest.approx(10),
        ),
    ],
    ids=lambda value: value["do"] if isinstance(value, dict) else "",
)
def test_a_fault_is_seen_by_the_client(bench: Bench, fault: dict[str, Any], sign: Any) -> None:
    faults = bench.good()
    faults(do="place", tcp=START)
    faults(do="wall")
    with client(bench.host, "watch") as process:
        wait_for_client(process)
        faults(**fault)
        resume(process)
        wait_for_client(process)
        faults(do="clear")
        faults(do="wall")
        during, after = outcome(process)
    assert sign(during), during
    assert fault["do"] == "close" or not sign(after), after


@emulated
def test_a_move_without_inverse_kinematics_ends_the_program(faults: Faults) -> None:
    with client(faults.host, "solve") as process:
        wait_for_client(process)
        faults(do="ik_fails")
        seen = outcome(process)
    assert seen["before"]
    assert not seen["after"]
    assert not seen["moved"]
    assert faults.state()["runtime"] == "STOPPED"


@emulated
def test_a_function_that_is_not_emulated_returns_false(faults: Faults) -> None:
    """A new program executes linear moves again."""
    seen = run_scenario(faults.host, "unsupported move")
    assert seen == {"moved": False, "stopped": True, "after": False, "again": True}


@emulated
def test_registers_belong_to_one_client(faults: Faults) -> None:
    seen = run_scenario(faults.host, "two clients")
    assert "already in use" in seen["error"]
    assert seen["unharmed"]
    faults(do="registers")
    assert "already in use" in run_scenario(faults.host, "control error")["error"]
    faults(do="clear")
    assert run_scenario(faults.host, "control error")["error"] == ""


@emulated
def test_an_e_series_requires_remote_control(bench: Bench) -> None:
    faults = bench.fresh("--hz", "500")
    faults(do="remote", on=False)
    assert "remote control" in run_scenario(bench.host, "control error")["error"]
    bench.close()


@emulated
def test_the_io_client_sets_the_speed_slider(faults: Faults) -> None:
    assert run_scenario(faults.host, "slide")["seen"]


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
