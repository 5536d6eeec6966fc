"""The driver against the emulator on a terminal: threads, processes and time are real."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from robot.drivers.create.driver import CreateDriver, NoAnswer, NotSafe
from robot.drivers.create.driver_config import CommandRefused, CreateConfig, StopReason
from robot.drivers.create.serial_link import NoPort
from tactile.base.errors import InputError
from tests.helpers.live import until
from tests.robot.drivers.create.serial_lines import Emulated

pytest.importorskip("serial", reason="needs pyserial")
pytest.importorskip("termios", reason="needs pseudo-terminals")
import serial


@pytest.fixture
def emulated() -> Iterator[Emulated]:
    robot = Emulated()
    try:
        yield robot
    finally:
        robot.close()


def create(emulated: Emulated, **settings: float) -> CreateDriver:
    """A driver with longer time limits than usual, since the machine may be busy. Its watchdog does not wait
    for a disconnected port, since the next emulator may have a terminal of the same name."""
    usual = {"silence": 5.0, "patience": 5.0, "replug": 0.01}
    return CreateDriver(CreateConfig(port=emulated.path, **{**usual, **settings}))


def drive_for(driver: CreateDriver, seconds: float, forward: float, turn: float = 0.0) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        driver.drive(forward, turn)
        time.sleep(0.05)


def drive_and_poll(driver: CreateDriver) -> None:
    """Drives until two more replies are good or lost."""
    before = driver.counts.good + driver.counts.lost
    until(lambda: driver.drive(0.1, 0.0) or driver.counts.good + driver.counts.lost >= before + 2)


def stop_and_read(driver: CreateDriver) -> None:
    """Stops and reads the last millimetres."""
    driver.stop()
    good = driver.counts.good
    until(lambda: driver.counts.good > good + 1)


def test_odometry_is_accurate_to_the_quantisation(emulated: Emulated) -> None:
    with create(emulated) as driver:
        total = 0.0
        for forward, turn in ((0.15, 0.0), (0.1, 0.5), (0.0, -0.8), (-0.1, 0.0)):
            drive_for(driver, 0.4, forward, turn)
            total += driver.odometry().dtheta
        stop_and_read(driver)
        last = driver.odometry()
        truth = emulated.do("state")
        assert driver.active_stop is None
    assert abs(total + last.dtheta - truth["turned"]) < math.radians(1) + 1e-6
    assert truth["unknown"] <= 4  # zero bytes of `STOP_ANYHOW`
    assert emulated.do("state")["mode"] == "PASSIVE"


def test_a_straight_line_is_measured_to_the_millimetre(emulated: Emulated) -> None:
    with create(emulated) as driver:
        drive_for(driver, 0.8, 0.2)
        stop_and_read(driver)
        odometry = driver.odometry()
        truth = emulated.do("state")
    assert abs(odometry.dx - truth["x"]) < 1e-3 + 1e-9
    assert odometry.dy == odometry.dtheta == 0
    assert truth["x"] > 0.1
    assert odometry.dt > 0.8


def test_speeds_above_the_limit_are_not_sent(emulated: Emulated) -> None:
    with create(emulated, speed=0.12) as driver:
        for forward, turn in ((0.121, 0), (0.1, 0.5), (math.nan, 0), (0, math.inf), (-1e300, 0), (0.12, 0)):
            try:
                driver.drive(forward, turn)
            except CommandRefused:
                assert (forward, turn) != (0.12, 0)
            time.sleep(0.06)
        until(lambda: emulated.do("state")["wheels"] == [120, 120])
    drives = emulated.do("state")["drives"]
    assert max(max(abs(right), abs(left)) for _, right, left in drives) == 120


def test_the_robot_stops_without_further_commands(emulated: Emulated) -> None:
    with create(emulated, patience=2.0) as driver:
        driver.drive(0.1, 0.0)
        until(lambda: emulated.do("state")["wheels"] == [100, 100])
        until(lambda: emulated.do("state")["wheels"] == [0, 0])
        assert driver.active_stop is None


def test_a_bump_stops_the_robot(emulated: Emulated) -> None:
    with create(emulated) as driver:
        drive_for(driver, 0.2, 0.1)
        emulated.do("bump")
        until(lambda: driver.active_stop)
        until(lambda: emulated.do("state")["wheels"] == [0, 0])
        with pytest.raises(CommandRefused, match="bumped"):
            driver.drive(0.1, 0.0)
        driver.release()
        until(lambda: driver.drive(-0.1, 0.0) or emulated.do("state")["wheels"] == [-100, -100])


def test_replies_may_arrive_in_pieces(emulated: Emulated) -> None:
    with create(emulated) as driver:
        emulated.do("trickle", seconds=0.004)
        drive_for(driver, 0.6, 0.2)
        stop_and_read(driver)
        assert abs(driver.odometry().dx - emulated.do("state")["x"]) < 1e-3 + 1e-9


def test_driving_continues_after_garbage_and_cut_replies(emulated: Emulated) -> None:
    with create(emulated) as driver:
        for count in range(6):
            emulated.do("garbage", bytes=7 * count + 1)
            drive_and_poll(driver)
            emulated.do("cut", bytes=count)
            drive_and_poll(driver)
        stop_and_read(driver)
        odometry, truth, counts = driver.odometry(), emulated.do("state"), driver.counts
        assert driver.active_stop is None
        assert driver.gap()
    assert counts.lost >= 6
    assert counts.stray > 0
    assert odometry.dx <= truth["x"] + 1e-3  # test_control_loop.py limits the difference


def test_unplugging_stops_a_driving_robot(emulated: Emulated) -> None:
    driver = create(emulated)
    driver.start()
    try:
        drive_for(driver, 0.2, 0.1)
        emulated.do("unplug")
        until(lambda: driver.active_stop)
        assert driver.active_stop
        assert driver.active_stop.reason is StopReason.UNPLUGGED
        with pytest.raises(CommandRefused, match="unplugged"):
            driver.drive(0.1, 0.0)
        driver.stop()
        driver.odometry()
    finally:
        driver.close()
    driver.close()
    with pytest.raises(CommandRefused, match="not started"):
        driver.drive(0.1, 0.0)


@pytest.mark.parametrize("killed", [False, True])
def test_a_rolling_robot_is_stopped_when_its_port_returns(tmp_path: Path, killed: bool) -> None:
    """By the watchdog process: the driver, or the program that it runs in, has ended."""
    link = str(tmp_path / "create.tty")
    robot = Emulated("--config", json.dumps({"port": link}))
    program = subprocess.Popen([sys.executable, "-c", DRIVES, link])
    try:
        until(lambda: robot.do("state")["wheels"] == [100, 100])
        robot.do("unplug")
        if killed:
            program.kill()
        else:
            assert program.wait(30) != 0  # refused to drive on
        assert robot.do("state")["wheels"] == [100, 100]
        robot.do("plug")
        until(lambda: robot.do("state")["mode"] == "PASSIVE")
        assert robot.do("state")["wheels"] == [0, 0]
    finally:
        program.kill()
        program.wait()
        robot.close()


def test_a_hanging_watchdog_is_noticed(emulated: Emulated) -> None:
    with create(emulated, patience=1.0) as driver:
        assert driver.watchdog is not None
        until(lambda: driver.drive(0.1, 0.0) or emulated.do("state")["wheels"] == [100, 100])
        os.kill(driver.watchdog.pid, signal.SIGSTOP)
        until(lambda: driver.active_stop)
        assert driver.active_stop
        assert driver.active_stop.reason is StopReason.UNGUARDED
        until(lambda: emulated.do("state")["wheels"] == [0, 0])


def test_switching_off_is_reported(emulated: Emulated) -> None:
    with create(emulated, silence=1.0) as driver:
        drive_for(driver, 0.2, 0.1)
        emulated.do("off")
        until(lambda: driver.active_stop)
        assert driver.active_stop
        assert driver.active_stop.reason is StopReason.SILENT


DRIVES = """
import sys, time
from robot.drivers.create.driver import CreateDriver
from robot.drivers.create.driver_config import CreateConfig
driver = CreateDriver(CreateConfig(port=sys.argv[1], patience=1.0, silence=5.0))
driver.start()
while True:
    driver.drive(0.1, 0.0)
    time.sleep(0.05)
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_the_watchdog_stops_a_killed_or_hanging_program(emulated: Emulated, how: int) -> None:
    process = subprocess.Popen([sys.executable, "-c", DRIVES, emulated.path])
    try:
        until(lambda: emulated.do("state")["wheels"] == [100, 100])
        os.kill(process.pid, how)
        until(lambda: emulated.do("state")["wheels"] == [0, 0])
        drives = len(emulated.do("state")["drives"])
        time.sleep(0.3)
        assert len(emulated.do("state")["drives"]) == drives  # one stop, by the watchdog
    finally:
        process.kill()
        process.wait()


HANGS = """
import os, signal, time
from robot.drivers.create import protocol
from robot.drivers.create.serial_link import SerialLink
send, ask = SerialLink.send, SerialLink.ask
def ask_slowly(link, elapsed):
    time.sleep(0.3)  # so that the first poll commands the first motion
    return ask(link, elapsed)
SerialLink.ask = ask_slowly
def send_and_hang(link, command):
    send(link, command)
    if command == protocol.drive(100, 100):
        os.kill(os.getpid(), signal.SIGSTOP)
        time.sleep(1000)  # this thread may still run for a moment
SerialLink.send = send_and_hang
"""


def test_a_program_that_hangs_right_after_its_first_command_is_stopped(emulated: Emulated) -> None:
    process = subprocess.Popen([sys.executable, "-c", HANGS + DRIVES, emulated.path])
    try:
        until(lambda: emulated.do("state")["wheels"] == [100, 100])
        until(lambda: emulated.do("state")["wheels"] == [0, 0])
    finally:
        process.kill()
        process.wait()


def test_the_robot_stops_when_the_watchdog_ends(emulated: Emulated) -> None:
    with create(emulated) as driver:
        driver.drive(0.1, 0.0)
        assert driver.watchdog is not None
        os.kill(driver.watchdog.pid, signal.SIGKILL)
        until(lambda: driver.active_stop)
        assert driver.active_stop
        assert driver.active_stop.reason is StopReason.UNGUARDED
        until(lambda: emulated.do("state")["wheels"] == [0, 0])


def test_ports_without_a_create_are_refused() -> None:
    with pytest.raises(NoPort, match="no such port"):
        CreateDriver(CreateConfig(port="/dev/ttyNONE")).start()
    with pytest.raises(NoPort, match="/dev/null"):
        CreateDriver(CreateConfig(port="/dev/null")).start()
    master, slave = os.openpty()
    try:
        with pytest.raises(NoAnswer, match="switch it on"):
            CreateDriver(CreateConfig(port=os.ttyname(slave))).start()
    finally:
        os.close(master)
        os.close(slave)


def test_a_second_program_is_refused(emulated: Emulated) -> None:
    with create(emulated) as driver:
        with pytest.raises(NoPort, match="another program"):
            CreateDriver(CreateConfig(port=emulated.path)).start()
        drive_for(driver, 0.2, 0.1)
        assert driver.active_stop is None
    with create(emulated) as driver:  # the port is free again
        assert driver.active_stop is None


def test_a_lifted_robot_is_not_started(emulated: Emulated) -> None:
    emulated.do("drop")
    with pytest.raises(NotSafe, match="set it on all its wheels"):
        CreateDriver(CreateConfig(port=emulated.path)).start()


def test_the_error_for_missing_pyserial_has_a_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(InputError, match="pip install"):
        CreateDriver(CreateConfig(port="/dev/ttyUSB0")).start()


def test_importing_the_driver_does_not_need_pyserial() -> None:
    modules = "sys, robot.drivers.create.driver, robot.emulators.create"
    code = f"import {modules}; print({{'serial', 'jax'}} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "set()"


def test_the_emulator_requires_its_baud_rate(emulated: Emulated) -> None:
    answers = []
    for baud in (57600, 115200):
        with serial.Serial(emulated.path, baud, timeout=30) as port:
            port.write(bytes([128, 131, 149, 2, 35, 7]))
            answers.append(port.read(2))
    assert answers[0] == b"\x02\x00"
    assert answers[1] != answers[0]


def test_the_emulator_answers_invalid_requests_with_an_error(emulated: Emulated) -> None:
    assert "error" in emulated.do("dance")
    assert "error" in emulated.do("garbage")
    assert emulated.do("state")["mode"] == "OFF"
