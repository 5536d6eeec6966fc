"""Emulated heads for tests: one in memory in simulated time, and one in a process."""

from functools import partial

import numpy as np

from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.decoder import Decoder
from robot.drivers.head.usb_protocol import Command, CommandKind, FeedbackMode
from robot.emulators.head.emulated_device import EmulatedHead
from robot.emulators.head.emulator_config import CONTROL_PORT, HeadEmulatorConfig
from robot.emulators.head.whiskers import BLOCK, AlongPath, Whiskers
from robot.world.scene import KidnapConfig, make_scene
from robot.world.walls import Walls
from tactile.whisker_geometry import ur10_head
from tests.helpers.live import emulator

TABLE = Walls(np.array([[-9.0, -9.0, 9.0, 9.0]]), np.array([0.05]))
"""A plate under the head, 5 cm high: every whisker touches it with its tip."""


def drive(mode=FeedbackMode.RCP, threshold=0.04, **changes):
    """A whisk with the paper's settings."""
    numbers = np.full(18, wire.to_counts(np.array(threshold)))
    usual = {"amplitude": np.radians(65), "frequency": 1.0, "gain": 4.0, "window": 0.01}
    return Command(CommandKind.DRIVE, mode, numbers=numbers, **usual | changes)


open_drive = partial(drive, FeedbackMode.OPEN)


def world(config):
    head = ur10_head(config.head)
    return make_scene(config.maze, config.path, config.motion, KidnapConfig(), head, config.seed)


class HostedHead:
    """An emulated head in memory with a host, which reads it and keeps it awake, in simulated time."""

    def __init__(self, config=None, walls=TABLE, place=None):
        self.config = config or HeadEmulatorConfig()
        here = AlongPath(world(self.config).path._replace(time=np.zeros(1), pose=np.zeros((1, 3))))
        self.whiskers = Whiskers(self.config, walls, place or here)
        self.bridge = EmulatedHead(self.config, self.whiskers, 0.0)
        self.decoder, self.now = Decoder(self.whiskers.count, 3), 0.0

    def start(self, *commands):
        self.bridge.control(wire.REQUEST_OUT, wire.Request.START, 0, 0, self.now)
        for command in commands:
            self.send(command)
        return self

    def stop(self):
        self.bridge.control(wire.REQUEST_OUT, wire.Request.STOP, 0, 0, self.now)

    def send(self, command):
        self.bridge.bulk_out(command.pack(), self.now)

    def pass_by(self, seconds, awake=True, read=True):
        """Advances time by some seconds; returns the frames read."""
        end, got = self.now + seconds, []
        while self.now < end - 1e-9:
            if awake:
                self.send(wire.KEEP_ALIVE)
            self.now += BLOCK
            while self.bridge.advance(self.now + 1e-6):
                pass
            if read:
                got.append(self.read())
        return self.decoder.feed(b"".join(got))

    def read(self, later=0.0):
        return self.bridge.bulk_in(10**9, self.now + later)

    def readings(self, seconds):
        """Advances time; angles [N, whiskers] and deflections [N, whiskers, 2] of the frames read."""
        return wire.to_radians(self.pass_by(seconds).values)

    def do(self, fault, **arguments):
        return self.bridge.do({"do": fault, **arguments}, self.now)


def started(*commands, **settings):
    """A head of these settings above `TABLE` that streams and executes commands."""
    return HostedHead(HeadEmulatorConfig.model_validate(settings)).start(*commands)


def running(config, folder):
    """An emulated head in its own process, until the end of the block."""
    file = folder / "head.json"
    file.write_text(config.model_dump_json())
    return emulator("robot.emulators.head", CONTROL_PORT, config.host, "--config", str(file))
