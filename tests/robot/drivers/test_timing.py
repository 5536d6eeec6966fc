"""Clock synchronisation under any delays, drift and jumps; lateness of a loop, priorities, imports."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot.drivers.clock_sync import JUMP, MAX_DRIFT, RESIDUAL_QUANTILE, WINDOW, ClockSync
from robot.drivers.outcome import SessionOutcome
from robot.drivers.processes import WINDOW as SECOND
from robot.drivers.processes import LatenessMeter
from robot.drivers.ur10.driver_config import ArmConfig
from robot.drivers.ur10.safety import ended_script_finding, stale_finding
from tactile.base.random_streams import stream

SHORTEST = 2e-4  # transmission delay, s


def pairs(seconds, rate=100.0, ppm=50.0, offset=3e4, seed=0):
    """(device, arrival, true host) times [N], s, with long-tailed delays of up to 32 ms."""
    random = stream(seed, "delays")
    host = offset + np.arange(round(seconds * rate)) / rate
    device = 17.0 + (host - offset) * (1 + ppm * 1e-6)
    delay = SHORTEST + np.minimum(random.exponential(4e-4, len(host)), 0.032)
    spikes = random.random(len(host)) < 0.02
    delay[spikes] += random.uniform(0, 0.032, spikes.sum())
    return device, np.maximum.accumulate(host + delay), host


def fit_clock(device, arrival, clock=None):
    clock = clock or ClockSync()
    for one, other in zip(device, arrival, strict=True):
        clock.observe(one, other)
    return clock


@given(st.floats(-150, 150), st.integers(0, 30), st.sampled_from([100.0, 125.0, 500.0]))
def test_host_time_is_accurate_to_the_shortest_delay(ppm, seed, rate):
    device, arrival, host = pairs(8, rate, ppm, seed=seed)
    clock = fit_clock(device, arrival)
    off = clock.to_host(device) - host - SHORTEST
    assert np.abs(off[-round(2 * rate) :]).max() < 2e-4  # while single arrivals are up to 32 ms off
    assert (arrival - clock.to_host(device)).min() > -1e-9
    assert abs(clock.scale - 1 / (1 + ppm * 1e-6)) < 6e-5
    assert clock.jumps == 0


@pytest.mark.parametrize("drift", [-0.8e-6, 0.8e-6])
def test_drift_is_tracked(drift):
    device, arrival, host = pairs(4 * WINDOW, 50.0, ppm=0)
    device = device + drift * (host - host[0]) ** 2  # by 192 ppm at the end
    clock = ClockSync()
    off = []
    for one, other, real in zip(device, arrival, host, strict=True):
        clock.observe(one, other)
        off.append(clock.to_host(one) - real - SHORTEST)
    assert np.abs(off[100:]).max() < 6e-4
    assert clock.jumps == 0
    whole = fit_clock(device, arrival)  # without a reading in between
    assert [whole.to_host(0.0), whole.residual] == [clock.to_host(0.0), clock.residual]


def test_the_residual_is_a_quantile_of_the_delays():
    device, arrival, host = pairs(20)
    early = np.quantile(arrival - host - SHORTEST, RESIDUAL_QUANTILE)
    assert fit_clock(device, arrival).residual == pytest.approx(early, abs=5e-5)
    assert fit_clock(device, host).residual < 1e-9
    lucky = host + np.where(np.arange(len(host)) % 50 == 0, 0.0, 0.02)
    assert fit_clock(device, lucky).residual == pytest.approx(0.02, abs=1e-3)
    assert ClockSync().residual == 0.0


@pytest.mark.parametrize("jump", [-3600.0, -1.0, -0.05, 0.15, 1.0, 4295.0])
def test_jumps_are_detected_at_once_and_restart_the_fit(jump):
    device, arrival, host = pairs(20)
    half = len(device) // 2
    clock = fit_clock(device[:half], arrival[:half])
    assert clock.jumps == 0
    late = int(np.argmax((arrival - host)[half:] < JUMP / 5)) + 1
    fit_clock(device[half : half + late] + jump, arrival[half : half + late], clock)
    assert clock.jumps == 1
    fit_clock(device[half + late :] + jump, arrival[half + late :], clock)
    assert clock.jumps == 1
    assert np.abs(clock.to_host(device[half + 200 :] + jump) - host[half + 200 :] - SHORTEST).max() < 2e-4


def test_a_small_step_back_is_followed_gradually():
    device, arrival, host = pairs(20 + WINDOW, rate=20.0)
    clock = fit_clock(device[:200], arrival[:200])
    fit_clock(device[200:] - 0.04, arrival[200:], clock)
    assert clock.jumps == 0
    assert abs(clock.to_host(device[-1] - 0.04) - host[-1] - SHORTEST) < 1e-3


@pytest.mark.parametrize("case", ["busy", "gap", "late at first", 0.5, 2.0, 5.0])
def test_what_delays_messages_is_not_a_jump(case):
    """A number: the host is suspended for so many s, and all delayed messages arrive at once."""
    device, arrival, host = pairs(30, offset=0.0)
    there = np.ones(len(host), bool)
    if case == "busy":
        arrival[(host > 8) & (host < 20)] += 0.04
    elif case == "gap":  # the device's clock continues without messages
        there = (host < 5) | (host > 25)
    elif isinstance(case, float):
        asleep = (host > 8) & (host < 8 + case)
        arrival[asleep] = 8 + case + 1e-4 * np.arange(asleep.sum())
    else:
        arrival[0] += 0.009
    clock = fit_clock(device[there], np.maximum.accumulate(arrival)[there])
    assert clock.jumps == 0
    assert np.abs(clock.to_host(device[-200:]) - host[-200:] - SHORTEST).max() < 2e-4


@pytest.mark.parametrize("step", [0.002, 0.05])
def test_repeated_time_stamps(step):
    """A coarse clock: the first arrival of a time stamp counts."""
    device, arrival, _ = pairs(5, rate=500.0)
    device = np.floor(device / step) * step
    clock = fit_clock(device, arrival)
    assert (arrival - clock.to_host(device)).min() > -1e-9
    assert clock.jumps == 0


def test_without_observations():
    with pytest.raises(ValueError, match="no observation"):
        ClockSync().to_host(1.0)
    clock = fit_clock(np.array([5.0]), np.array([105.0]))
    assert clock.to_host(6.0) == 106.0


@given(st.lists(st.tuples(st.floats(0, 0.3), st.floats(0, 0.3)), min_size=1, max_size=40))
def test_any_observations_are_accepted(steps):
    device, arrival = np.cumsum(np.array(steps), axis=0).T
    clock = fit_clock(device, arrival)
    assert np.isfinite(clock.to_host(device)).all()
    assert abs(clock.scale - 1) <= MAX_DRIFT * 1.0001
    assert clock.residual >= 0


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


def test_the_largest_delay_of_the_last_second_counts():
    meter = LatenessMeter(0.005, 10.0)
    assert meter.turn(10.005) == pytest.approx(0.0, abs=1e-12)
    assert meter.turn(10.205) == pytest.approx(0.195)
    assert meter.turn(10.215) == pytest.approx(0.195)
    assert meter.worst(10.205 + SECOND) == pytest.approx(0.195)
    assert meter.worst(10.206 + SECOND) == 0.0
    assert meter.turn(12.0) == pytest.approx(1.78)


def test_missing_states_and_an_ended_script_are_the_fault_of_a_late_machine_or_not():
    assert stale_finding(0.11, 0.049, 0.1).outcome is SessionOutcome.ARM_STALE
    finding = stale_finding(0.11, 0.05, 0.1)
    assert finding.outcome is SessionOutcome.HOST_LATE
    assert "this machine was 0.050 s late" in finding.detail
    for config, unreset, late, machine in (
        (REAL, 0.099, 0.09, None),  # reset in time: something else ended the script
        (REAL, 0.13, 0.049, None),  # the controller or the network is slow
        (REAL, 0.13, 0.05, 0.05),
        (ArmConfig(), 0.13, 0.01, 0.03),  # the emulator is slow, on this machine
        (ArmConfig(), 0.05, 0.01, None),
    ):
        finding = ended_script_finding(config, unreset, late)
        assert finding.outcome is (SessionOutcome.HOST_LATE if machine else SessionOutcome.ARM_GONE)
        assert ("was not reset for 0.130 s" in finding.detail) == (unreset > 0.1)
        assert ("this machine was" in finding.detail) == bool(machine)
        assert not machine or f"was {machine:.3f} s late" in finding.detail


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="no scheduling policies")
def test_control_before_mapping_before_drawing():
    subprocess.run([sys.executable, "-c", PRIORITIES], check=True, timeout=60)


def test_importing_drivers_and_readers_imports_no_library_of_a_device_or_format():
    code = """
import sys
import robot.drivers.create.driver, robot.drivers.head.whisk_control, robot.recordings.formats
heavy = {"usb", "libusb_package", "serial", "mcap", "zstandard", "scipy", "jax", "ratslam", "robot.emulators"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
