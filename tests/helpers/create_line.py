"""An emulated Create behind a serial port in memory, in simulated time; a bench check of it."""

from contextlib import contextmanager

import numpy as np

from robot.drivers.create import protocol
from robot.drivers.create.driver import PAUSE, ControlLoop
from robot.drivers.create.driver_config import CreateConfig
from robot.drivers.create.serial_link import SerialLink
from robot.emulators.create import CreateEmulatorConfig, EmulatedCreate
from robot.live.create_bench import Bench


class Line:
    """A serial port in memory: commands reach the robot at once, `mangle` changes its replies, which take the
    latency of its firmware; a read that times out advances its clock `now`, s."""

    def __init__(self, config=None, arena=None):
        self.robot = EmulatedCreate(config or CreateEmulatorConfig(), arena)
        self.now, self.timeout, self.gone, self.waiting = 100.0, 0.0, False, b""
        self.mangle = lambda reply: reply
        self.due = -np.inf  # time of the last reply

    def wait(self, seconds):
        self.now += seconds
        self.robot.advance(seconds)

    @property
    def in_waiting(self):
        self._attached()
        return len(self.waiting) if self.now >= self.due else 0

    def read(self, size=1):
        self._attached()
        if self.waiting and self.due > self.now:
            self.wait(min(self.due - self.now, self.timeout or 0.0))
        if self.due > self.now:
            return b""
        data, self.waiting = self.waiting[:size], self.waiting[size:]
        if len(data) < size:
            self.wait(self.timeout or 0.0)
        return data

    def write(self, data):
        self._attached()
        for reply in self.robot.receive(data):
            self.waiting += self.mangle(reply)
            self.due = self.now + self.robot.config.firmware.latency
        return len(data)

    def close(self): ...

    def _attached(self):
        if self.gone:
            raise OSError(5, "Input/output error")

    def control_loop(self, tell=None, **settings):
        config = CreateConfig(**settings)
        link = SerialLink(self, protocol.MODELS[config.model])
        for command in (protocol.START, protocol.SAFE):
            link.send(command)
            self.wait(PAUSE)
        link.ask(float("inf"))
        return ControlLoop(config, link, lambda: self.now, tell)


class SimulatedDriver:
    """The driver of a robot on a `Line`, whose thread runs while the test sleeps."""

    def __init__(self, line, config, tell=None):
        self.line, self.period = line, 1 / config.rate
        self.loop = line.control_loop(tell, **config.model_dump())

    active_stop = property(lambda self: self.loop.active_stop)

    def drive(self, forward, turn):
        self.loop.steer(forward, turn)
        self.loop.poll()

    def stop(self):
        self.drive(0.0, 0.0)

    def refresh(self):
        self.loop.counters.due = True
        self.loop.poll()

    def sleep(self, seconds):
        end = self.line.now + seconds
        while self.line.now < end:
            due = self.line.now + self.period
            self.loop.poll()
            self.line.wait(max(1e-9, min(due, end) - self.line.now))


class SimulatedBench:
    """A bench check of an emulated robot whose user reads 1 degree and 5 mm."""

    def __init__(self, firmware, wheel_base, marks=True):
        self.line = Line(CreateEmulatorConfig(firmware=firmware, wheel_base=wheel_base))
        self.driver, self._base, self._marks = None, self.line.robot.base, marks
        self.bench = Bench(self.open, lambda: self.line.now, lambda s: self.driver.sleep(s), self.measure)

    @contextmanager
    def open(self, config, tell):
        self.driver = SimulatedDriver(self.line, config, tell)
        yield self.driver

    def measure(self, run):
        before, self._base = self._base, self.line.robot.base
        if not self._marks:
            return None
        if run.turns:
            return float(round(np.degrees(self._base.turned - before.turned)))
        return round((self._base.travelled - before.travelled) / 0.005) * 0.005
