"""Emulated heads for tests: one in memory in simulated time, and one in a process."""

from __future__ import annotations

from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.decoder import Decoder, Frames
from robot.drivers.head.usb_protocol import Command, CommandKind, FeedbackMode
from robot.emulators.head.emulated_device import EmulatedHead
from robot.emulators.head.emulator_config import CONTROL_PORT, HeadEmulatorConfig
from robot.emulators.head.whiskers import BLOCK, AlongPath, PoseSource, Whiskers
from robot.world.scene import KidnapConfig, Scene, make_scene
from robot.world.walls import Walls
from tactile.whisker_geometry import ur10_head
from tests.helpers.live import Faults, emulator

TABLE = Walls(np.array([[-9.0, -9.0, 9.0, 9.0]]), np.array([0.05]))
"""A plate under the head, 5 cm high: every whisker touches it with its tip."""


def drive(mode: FeedbackMode = FeedbackMode.RCP, threshold: float = 0.04, **changes: Any) -> Command:
    """A whisk with the paper's settings."""
    numbers = np.full(18, wire.to_counts(np.array(threshold)))
    usual = {"amplitude": np.radians(65), "frequency": 1.0, "gain": 4.0, "window": 0.01}
    return Command(CommandKind.DRIVE, mode, numbers=numbers, **usual | changes)


def open_drive(**changes: Any) -> Command:
    """A whisk without feedback."""
    return drive(FeedbackMode.OPEN, **changes)


def world(config: HeadEmulatorConfig) -> Scene:
    """The scene of a configuration."""
    return make_scene(
        config.maze, config.path, config.motion, KidnapConfig(), ur10_head(config.head), config.seed
    )


class HostedHead:
    """An emulated head in memory with a host, which reads it and keeps it awake, in simulated time."""

    def __init__(
        self, config: HeadEmulatorConfig | None = None, walls: Walls = TABLE, place: PoseSource | None = None
    ) -> None:
        self.config = config or HeadEmulatorConfig()
        here = AlongPath(world(self.config).path._replace(time=np.zeros(1), pose=np.zeros((1, 3))))
        self.whiskers = Whiskers(self.config, walls, place or here)
        self.bridge = EmulatedHead(self.config, self.whiskers, 0.0)
        self.decoder, self.now = Decoder(self.whiskers.count, 3), 0.0

    def start(self, *commands: Command) -> HostedHead:
        """Starts the stream of frames and sends commands."""
        self.bridge.control(wire.REQUEST_OUT, wire.Request.START, 0, 0, self.now)
        for command in commands:
            self.send(command)
        return self

    def stop(self) -> None:
        """Stops the stream of frames."""
        self.bridge.control(wire.REQUEST_OUT, wire.Request.STOP, 0, 0, self.now)

    def send(self, command: Command) -> None:
        self.bridge.bulk_out(command.pack(), self.now)

    def pass_by(self, seconds: float, awake: bool = True, read: bool = True) -> Frames:
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

    def read(self, later: float = 0.0) -> bytes:
        """All bytes that are queued, read some seconds later."""
        return self.bridge.bulk_in(10**9, self.now + later)

    def angles(self, seconds: float) -> np.ndarray:
        """Advances time by some seconds; angles [N, whiskers] of the frames read."""
        return wire.to_radians(self.pass_by(seconds).values)[0]

    def deflections(self, seconds: float) -> np.ndarray:
        """Advances time by some seconds; deflections [N, whiskers, 2] of the frames read."""
        return wire.to_radians(self.pass_by(seconds).values)[1]

    def do(self, fault: str, **arguments: Any) -> dict[str, Any]:
        return self.bridge.do({"do": fault, **arguments}, self.now)


def started(*commands: Command, **settings: Any) -> HostedHead:
    """A head of these settings above `TABLE` that streams and executes commands."""
    return HostedHead(HeadEmulatorConfig.model_validate(settings)).start(*commands)


def running(config: HeadEmulatorConfig, folder: Path) -> AbstractContextManager[Faults]:
    """An emulated head in its own process, until the end of the block."""
    file = folder / "head.json"
    file.write_text(config.model_dump_json())
    return emulator("robot.emulators.head", CONTROL_PORT, config.host, "--config", str(file))
