"""Lateness of a loop, priorities of processes, which findings name this machine, and what is imported."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from robot.drivers.outcome import SessionOutcome
from robot.drivers.processes import WINDOW, LatenessMeter
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import ended_script_finding, stale_finding

REAL = ArmConfig(host="192.168.1.10")
PRIORITIES = """
import os, subprocess, sys, threading
from robot.drivers import processes as priority
def of(pid):
    return os.sched_getscheduler(pid), os.getpriority(os.PRIO_PROCESS, pid)
waiting = threading.Event()
other = threading.Thread(target=waiting.wait, daemon=True)
other.start()
before = of(0)
with priority.urgent():
    assert of(0) == of(other.native_id), "threads that run already"
    code = "import os; from robot.drivers.processes import step_back; step_back();"
    code += "print(os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0))"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    policy, niceness = map(int, child.stdout.split())
    assert policy == os.SCHED_OTHER
    assert niceness == min(19, of(0)[1] + priority.BACKGROUND)
    drawing = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    priority.put_last(drawing.pid)
    assert of(drawing.pid) == (os.SCHED_OTHER, priority.LOWEST)
    drawing.communicate(b"\\n")
assert of(0) == of(other.native_id) == before
waiting.set()
"""


def test_the_largest_delay_of_the_last_second_counts() -> None:
    meter = LatenessMeter(0.005, 10.0)
    assert meter.turn(10.005) == pytest.approx(0.0, abs=1e-12)
    assert meter.turn(10.205) == pytest.approx(0.195)
    assert meter.turn(10.215) == pytest.approx(0.195)
    assert meter.worst(10.205 + WINDOW) == pytest.approx(0.195)
    assert meter.worst(10.206 + WINDOW) == 0.0
    assert meter.turn(12.0) == pytest.approx(1.78)


@pytest.mark.parametrize(("late", "named"), [(0.049, False), (0.05, True)])
def test_states_that_are_missing_because_this_machine_is_late(late: float, named: bool) -> None:
    finding = stale_finding(0.11, late, 0.1)
    assert finding.outcome is (SessionOutcome.HOST_LATE if named else SessionOutcome.ARM_STALE)
    assert ("this machine was 0.050 s late" in finding.detail) == named


@pytest.mark.parametrize(
    ("config", "unreset", "late", "machine"),
    [
        (REAL, 0.099, 0.09, None),  # reset in time: something else ended the script
        (REAL, 0.13, 0.049, None),  # the controller or the network is slow
        (REAL, 0.13, 0.05, 0.05),
        (ArmConfig(), 0.13, 0.01, 0.03),  # the emulator is slow, on this machine
        (ArmConfig(), 0.05, 0.01, None),
    ],
)
def test_a_control_script_that_ended(config, unreset, late, machine):
    finding = ended_script_finding(config, unreset, late)
    assert finding.outcome is (SessionOutcome.HOST_LATE if machine else SessionOutcome.ARM_GONE)
    assert ("was not reset for 0.130 s" in finding.detail) == (unreset > 0.1)
    assert ("this machine was" in finding.detail) == bool(machine)
    assert not machine or f"was {machine:.3f} s late" in finding.detail


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no scheduling policies")
def test_control_before_mapping_before_drawing() -> None:
    """Whatever this system allows."""
    subprocess.run([sys.executable, "-c", PRIORITIES], check=True, timeout=60)


def test_importing_drivers_and_readers_imports_no_library_of_a_device_or_format() -> None:
    code = """
import sys
import robot.drivers.create.driver, robot.drivers.head.whisk_control, robot.recordings.formats
heavy = {"usb", "libusb_package", "serial", "mcap", "zstandard", "scipy", "jax", "ratslam", "robot.emulators"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
