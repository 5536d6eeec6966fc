"""The driver against the emulator on a terminal: threads, processes and time are real."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from contextlib import closing, contextmanager

import pytest

from robot.drivers.create.driver import CreateDriver, NoAnswer, NotSafe
from robot.drivers.create.driver_config import CommandRefused, CreateConfig, StopReason
from robot.drivers.create.serial_link import NoPort
from tactile.base.errors import InputError
from tests.helpers.live import until

pytest.importorskip("serial", reason="needs pyserial")
pytest.importorskip("termios", reason="needs pseudo-terminals")
import serial


class Emulated:
    """A process of the emulator; its port keeps its name when it is plugged in again."""

    def __init__(self, folder):
        self.path = str(folder / "create.tty")
        words = [sys.executable, "-m", "robot.emulators.create", "--config", json.dumps({"port": self.path})]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True, bufsize=1)
        assert self.process.stdout.readline().split()[0] == self.path

    def do(self, what, **more):
        self.process.stdin.write(json.dumps({"do": what, **more}) + "\n")
        return json.loads(self.process.stdout.readline())

    def wheels(self):
        """Speeds of the wheels, right and left, mm/s."""
        return self.do("state")["wheels"]

    def close(self):
        self.process.kill()
        self.process.communicate()


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    with closing(Emulated(tmp_path_factory.mktemp("create"))) as robot:
        yield robot


@pytest.fixture
def emulated(robot):
    """An emulated Create without faults, for drivers that end in order."""
    for request in ("plug", "clear"):
        robot.do(request)
    robot.do("trickle", seconds=0.0)
    return robot


@pytest.fixture
def alone(tmp_path):
    """An emulated Create of its own, for drivers whose process is killed or loses the port."""
    with closing(Emulated(tmp_path)) as robot:
        yield robot


def create(emulated, **settings):
    """A driver for a busy machine, whose watchdog does not wait for a disconnected port."""
    usual = {"silence": 5.0, "patience": 5.0, "replug": 0.01}
    return CreateDriver(CreateConfig(port=emulated.path, **{**usual, **settings}))


def drive_for(driver, seconds, forward, turn=0.0):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        driver.drive(forward, turn)
        time.sleep(0.05)


def stop_and_read(driver):
    driver.stop()
    good = driver.counts.good
    until(lambda: driver.counts.good > good + 1)


def test_ways_and_turns_are_measured_though_replies_arrive_in_pieces(emulated):
    """To the millimetre, and the degree at either end; test_control_loop.py limits it to one in all."""
    before = emulated.do("state")
    with create(emulated) as driver:
        emulated.do("trickle", seconds=0.004)
        drive_for(driver, 0.8, 0.2)
        stop_and_read(driver)
        straight, way = driver.odometry(), emulated.do("state")["travelled"] - before["travelled"]
        total = 0.0
        for forward, turn in ((0.15, 0.0), (0.1, 0.5), (0.0, -0.8), (-0.1, 0.0)):
            drive_for(driver, 0.4, forward, turn)
            total += driver.odometry().dtheta
        stop_and_read(driver)
        total += driver.odometry().dtheta
        truth = emulated.do("state")
        assert driver.active_stop is None
    assert straight.dx == pytest.approx(way, abs=2e-3)
    assert straight.dy == straight.dtheta == 0
    assert way > 0.1
    assert straight.dt > 0.8
    assert abs(total - truth["turned"] + before["turned"]) < math.radians(2)
    assert truth["unknown"] <= before["unknown"] + 8  # zero bytes of `STOP_ANYHOW`, of two drivers
    assert emulated.do("state")["mode"] == "PASSIVE"


def test_the_robot_stops_at_a_bump_and_without_further_commands(emulated):
    with create(emulated, patience=2.0) as driver:
        drive_for(driver, 0.2, 0.1)
        emulated.do("bump")
        assert until(lambda: driver.active_stop).reason is StopReason.BUMPED
        until(lambda: emulated.wheels() == [0, 0])
        with pytest.raises(CommandRefused, match="bumped"):
            driver.drive(0.1, 0.0)
        driver.release()
        until(lambda: driver.drive(-0.1, 0.0) or emulated.wheels() == [-100, -100])
        until(lambda: emulated.wheels() == [0, 0])
        assert driver.active_stop is None


def test_driving_continues_after_garbage_and_cut_replies(emulated):
    before = emulated.do("state")["travelled"]
    with create(emulated) as driver:
        for count in range(12):
            emulated.do("cut" if count % 2 else "garbage", bytes=count // 2 if count % 2 else 3 * count + 1)
            polled = driver.counts.good + driver.counts.lost
            until(lambda n=polled + 2: driver.drive(0.1, 0.0) or driver.counts.good + driver.counts.lost >= n)
        stop_and_read(driver)
        odometry, truth, counts = driver.odometry(), emulated.do("state")["travelled"], driver.counts
        assert driver.active_stop is None
        assert driver.gap()
    assert counts.lost >= 6
    assert counts.stray > 0
    assert odometry.dx <= truth - before + 2e-3  # test_control_loop.py limits the difference


def test_switching_off_and_unplugging_stop_a_driving_robot(emulated):
    with create(emulated, silence=1.0) as driver:
        drive_for(driver, 0.2, 0.1)
        emulated.do("off")
        assert until(lambda: driver.active_stop).reason is StopReason.SILENT
    with create(emulated) as driver:
        drive_for(driver, 0.2, 0.1)
        emulated.do("unplug")
        assert until(lambda: driver.active_stop).reason is StopReason.UNPLUGGED
        with pytest.raises(CommandRefused, match="unplugged"):
            driver.drive(0.1, 0.0)
        driver.stop()
        driver.odometry()
    driver.close()
    with pytest.raises(CommandRefused, match="not started"):
        driver.drive(0.1, 0.0)


@pytest.mark.parametrize("how", [signal.SIGSTOP, signal.SIGKILL])
def test_the_robot_stops_when_the_watchdog_hangs_or_ends(emulated, how):
    with create(emulated, patience=1.0) as driver:
        until(lambda: driver.drive(0.1, 0.0) or emulated.wheels() == [100, 100])
        os.kill(driver.watchdog.pid, how)
        assert until(lambda: driver.active_stop).reason is StopReason.UNGUARDED
        until(lambda: emulated.wheels() == [0, 0])


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
HANGS = """
import os, signal, time
from robot.drivers.create import protocol
from robot.drivers.create.serial_link import SerialLink
send, ask = SerialLink.send, SerialLink.ask
def ask_slowly(link, *words):
    time.sleep(0.3)  # so that the first poll commands the first motion
    return ask(link, *words)
SerialLink.ask = ask_slowly
def send_and_hang(link, command):
    send(link, command)
    if command == protocol.drive(100, 100):
        os.kill(os.getpid(), signal.SIGSTOP)
        time.sleep(1000)  # this thread may still run for a moment
SerialLink.send = send_and_hang
"""


@contextmanager
def driving(alone, code=DRIVES):
    program = subprocess.Popen([sys.executable, "-c", code, alone.path])
    try:
        until(lambda: alone.wheels() == [100, 100])
        yield program
    finally:
        program.kill()
        program.wait()


@pytest.mark.parametrize("killed", [False, True])
def test_a_rolling_robot_is_stopped_when_its_port_returns(alone, killed):
    with driving(alone) as program:
        alone.do("unplug")
        if killed:
            program.kill()
        else:
            assert program.wait(30) != 0  # refused to drive on
        assert alone.wheels() == [100, 100]
        alone.do("plug")
        until(lambda: alone.do("state")["mode"] == "PASSIVE")
        assert alone.wheels() == [0, 0]


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_the_watchdog_stops_a_killed_or_hanging_program(alone, how):
    with driving(alone) as program:
        os.kill(program.pid, how)
        until(lambda: alone.wheels() == [0, 0])
        drives = len(alone.do("state")["drives"])
        time.sleep(0.3)
        assert len(alone.do("state")["drives"]) == drives  # one stop, by the watchdog


def test_a_program_that_hangs_right_after_its_first_command_is_stopped(alone):
    with driving(alone, HANGS + DRIVES):
        until(lambda: alone.wheels() == [0, 0])


def test_ports_without_a_create_are_refused(monkeypatch):
    master, slave = os.openpty()
    try:
        for port, refusal, match in (
            ("/dev/null", NoPort, "/dev/null"),
            (os.ttyname(slave), NoAnswer, "switch it on"),
        ):
            with pytest.raises(refusal, match=match):
                CreateDriver(CreateConfig(port=port)).start()
    finally:
        os.close(master)
        os.close(slave)
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(InputError, match="pip install"):
        CreateDriver(CreateConfig(port="/dev/ttyUSB0")).start()


def test_a_second_program_and_a_lifted_robot_are_refused(emulated):
    with create(emulated) as driver:
        with pytest.raises(NoPort, match="another program"):
            CreateDriver(CreateConfig(port=emulated.path)).start()
        drive_for(driver, 0.2, 0.1)
        assert driver.active_stop is None
    with create(emulated) as driver:  # the port is free again
        assert driver.active_stop is None
    emulated.do("drop")
    with pytest.raises(NotSafe, match="set it on all its wheels"):
        create(emulated).start()


def test_the_emulator_requires_its_baud_rate_and_known_requests(alone):
    assert "error" in alone.do("dance")
    assert "error" in alone.do("garbage")
    assert alone.do("state")["mode"] == "OFF"
    answers = []
    for baud in (57600, 115200):
        with serial.Serial(alone.path, baud, timeout=30) as port:
            port.write(bytes([128, 131, 149, 2, 35, 7]))
            answers.append(port.read(2))
    assert answers[0] == b"\x02\x00"
    assert answers[1] != answers[0]
