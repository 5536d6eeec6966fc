"""The process of an emulated Create: its serial line and, with an arena, the bridge of its whiskers.

The serial line is a pseudo-terminal. Fault requests are lines of JSON, answered by a line: on standard input,
or on the bridge's fault port with `"device": "create"`; without that the port takes those of the bridge.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from robot.drivers.create.protocol import MODELS, Bumps
from robot.drivers.processes import urgent
from robot.emulators.create.emulator_config import CreateEmulatorConfig, CreateWorldConfig
from robot.emulators.create.robot import EmulatedCreate
from robot.emulators.head.emulated_device import EmulatedHead
from robot.emulators.head.server import open_server
from robot.emulators.head.whiskers import Block, SensorArray, block_samples
from robot.emulators.listening import answer_fault, do_fault
from robot.simulation.create.strain_sensors import BodyVibration, base_strains, bend_whiskers, fixed_whiskers
from robot.world.arena import make_arena
from robot.world.walls import segment_distance
from tactile.base.errors import InputError, os_errors_of
from tactile.base.files import temporary_path
from tactile.base.random_streams import stream


class _LineFaults:
    """Faults of the serial line."""

    def __init__(self, seed: int) -> None:
        self._random = stream(seed, "create garbage")
        self.garbage, self.lose, self.scramble, self.trickle = 0, 0, 0, 0.0
        self.cut: int | None = None

    def disturb(self, reply: bytes) -> bytes:
        """The reply after the pending faults."""
        if self.lose:
            self.lose -= 1
            return b""
        if self.scramble:
            self.scramble -= 1
            return self.noise(reply)
        if self.cut is not None:
            reply, self.cut = reply[: self.cut], None
        before, self.garbage = self._random.bytes(self.garbage), 0
        return before + reply

    def noise(self, reply: bytes) -> bytes:
        """The reply as received at another baud rate."""
        return self._random.bytes(len(reply))


class Terminal:
    """A pseudo-terminal that looks like a serial port to the program at its other end.

    Args:
        link: name of a link to it, which stays the same when it is plugged in again; None for no link.

    Attributes:
        master: descriptor of this end. path: name of the other end. plugged: whether it exists.

    Raises:
        InputError: the system has no pseudo-terminals, or the link's name is taken.
    """

    def __init__(self, link: str | None = None) -> None:
        try:
            import termios
            import tty
        except ImportError:
            raise InputError(sys.platform, "has no pseudo-terminals", "Linux or macOS") from None
        self._termios, self._tty = termios, tty
        self._link = None if link is None else Path(link)
        self.plugged = False
        self.plug()

    def plug(self) -> None:
        """Makes the terminal, or a new one after `unplug`."""
        self.master, self._slave = os.openpty()  # the slave stays open: without one, reads fail
        self._tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.path = os.ttyname(self._slave)
        if self._link is not None and os.path.lexists(self._link):
            left = self._link.is_symlink() and Path(os.readlink(self._link)).parent == Path(self.path).parent
            if not left:  # by an emulator that was killed
                cure = "choose another name for the emulated port (`live.create.port`)"
                expected = "a new name for the emulated port"
                raise InputError(str(self._link), "exists and is no emulated port", expected, cure)
        self.plugged = True
        if self._link is not None:
            new = temporary_path(self._link)
            with os_errors_of(self._link, "cannot be made", "a link"):
                new.symlink_to(self.path)
                new.replace(self._link)
            self.path = str(self._link)

    def has_baud_rate(self, baud: int) -> bool:
        """Whether the client has set this baud rate."""
        return bool(self._termios.tcgetattr(self._slave)[5] == getattr(self._termios, f"B{baud}"))

    def unplug(self) -> None:
        """Closes the terminal, as an unplugged cable would."""
        if self.plugged:
            self.plugged = False
            os.close(self.master)
            os.close(self._slave)
            if self._link is not None:
                self._link.unlink(missing_ok=True)


TICK = 0.005
"""Longest time between two moments at which the robot's motion is computed, s."""


class _CreateServer:
    """An emulated Create in real time; `start` begins to serve its serial line."""

    def __init__(self, config: CreateEmulatorConfig) -> None:
        world = config.world
        arena = None if world is None else make_arena(world.arena, config.seed)
        self.robot, self.faults = EmulatedCreate(config, arena), _LineFaults(config.seed)
        self.terminal = Terminal(config.port)
        self.began = time.monotonic()
        self._free = 0.0  # loop time at which the line has sent everything

    def start(self) -> None:
        """Serves the serial line in the running event loop."""
        asyncio.get_running_loop().add_reader(self.terminal.master, self._receive)

    def move(self, now: float) -> None:
        """Advances the robot to a time, s, host's monotonic clock."""
        self.robot.advance_to(now - self.began)

    def do(self, request: dict[str, Any]) -> dict[str, Any]:
        """Executes a fault request (`robot.emulators.listening.do_fault`)."""
        self.move(time.monotonic())
        robot, faults = self.robot, self.faults
        known: dict[str, Callable[..., object]] = {
            "bump": lambda: robot.touch(robot.bumps | Bumps.BUMPED),
            "drop": lambda: robot.touch(robot.bumps | Bumps.DROPPED_LEFT),
            "cliff": lambda: robot.touch(robot.bumps, cliff=True),
            "clear": self._clear,
            "off": robot.switch_off,
            "garbage": lambda bytes: setattr(faults, "garbage", int(bytes)),
            "cut": lambda bytes: setattr(faults, "cut", int(bytes)),
            "lose": lambda replies: setattr(faults, "lose", int(replies)),
            "scramble": lambda replies: setattr(faults, "scramble", int(replies)),
            "trickle": lambda seconds: setattr(faults, "trickle", float(seconds)),
            "unplug": self._unplug,
            "plug": self._plug,
            "state": self._state,
            "die": lambda: os._exit(1),
        }
        return do_fault(known, request)

    def _clear(self) -> None:
        self.robot.touch(Bumps(0))
        self.faults.lose = self.faults.scramble = 0

    def _unplug(self) -> None:
        if self.terminal.plugged:
            asyncio.get_running_loop().remove_reader(self.terminal.master)
        self.terminal.unplug()

    def _plug(self) -> None:
        if not self.terminal.plugged:
            self.terminal.plug()
            self.start()

    def _state(self) -> dict[str, Any]:
        robot = self.robot
        return {
            **robot.base._asdict(),
            "time": robot.time,
            "began": self.began,
            "wheels": [robot.right, robot.left],
            "mode": robot.mode.name,
            "bumps": int(robot.bumps),
            "plugged": self.terminal.plugged,
            "drives": robot.drives,
            "speeds": robot.speeds,
            "queries": robot.queries,
            "unknown": robot.unknown,
        }

    def _receive(self) -> None:
        self.move(time.monotonic())
        try:
            data = os.read(self.terminal.master, 4096)
        except OSError:  # no data after all
            return
        firmware = self.robot.config.firmware
        for whole in self.robot.receive(data):
            good = self.terminal.has_baud_rate(MODELS[firmware.model].baud)
            reply = self.faults.disturb(whole if good else self.faults.noise(whole))
            step = self.faults.trickle
            pieces = [reply[i : i + 1] for i in range(len(reply))] if step else [reply]
            for number, piece in enumerate(pieces):
                self._send(piece, step + (0.0 if number else firmware.latency))

    def _send(self, piece: bytes, after: float) -> None:
        """Sends bytes some time, s, after all bytes before them."""
        loop = asyncio.get_running_loop()
        now, master = loop.time(), self.terminal.master
        self._free = max(self._free, now) + after
        if self._free <= now:
            self._write(master, piece)
        else:
            self._free += 1e-6  # the order of equal times is not defined
            loop.call_at(self._free, self._write, master, piece)

    def _write(self, master: int, piece: bytes) -> None:
        if self.terminal.plugged and master == self.terminal.master:
            with contextlib.suppress(BlockingIOError):  # nobody reads
                os.write(master, piece)


def serve(config: CreateEmulatorConfig) -> None:
    """Emulates a Create until the process ends; prints the port and `ready` when it listens.

    Raises:
        InputError: no pseudo-terminals, an invalid arena, the port's name is taken, or the address of the
            bridge cannot be used.
    """
    server = _CreateServer(config)
    try:
        with urgent():
            asyncio.run(_run(config, server))
    finally:
        server.terminal.unplug()


async def _run(config: CreateEmulatorConfig, server: _CreateServer) -> None:
    async with contextlib.AsyncExitStack() as stack:
        if config.world is not None:
            random = stream(config.seed, "strain")
            whiskers = CreateWhiskers(config.world, server.robot, server.move, random)
            bridge = EmulatedHead(config.world.bridge, whiskers, time.monotonic())

            def do(request: dict[str, Any], now: float) -> dict[str, Any]:
                if request.get("device") != "create":
                    return bridge.do(request, now)
                del request["device"]
                return server.do(request)

            head = await stack.enter_async_context(open_server(config.world.bridge, bridge, do))
            task = asyncio.create_task(head.run())
            stack.callback(task.cancel)
        server.start()
        _read_requests(server)
        print(f"{server.terminal.path} ready", flush=True)
        while True:
            server.move(time.monotonic())
            await asyncio.sleep(TICK)


def _read_requests(server: _CreateServer) -> None:
    """Answers requests from standard input, in the running event loop, until it ends."""
    loop = asyncio.get_running_loop()

    def answer(line: str) -> None:
        print(answer_fault(line, server.do).decode(), end="", flush=True)

    def read() -> None:
        for line in sys.stdin:
            if line.strip():
                with contextlib.suppress(RuntimeError):  # the loop has ended
                    loop.call_soon_threadsafe(answer, line)

    threading.Thread(target=read, daemon=True, name="requests").start()


class CreateWhiskers(SensorArray):
    """The whiskers of a Create as a `SensorArray`: angles are 0, deflections the two strains.

    Args:
        move: advances the robot to a time, s, host's monotonic clock.
    """

    def __init__(
        self,
        config: CreateWorldConfig,
        robot: EmulatedCreate,
        move: Callable[[float], None],
        random: np.random.Generator,
    ) -> None:
        self.config, self._robot, self._move, self._random = config, robot, move, random
        self._fan = fixed_whiskers(config.whiskers)
        self._samples = block_samples(config.whiskers.rate)
        self._shaking = BodyVibration(config.whiskers.shake, config.whiskers.rate, random)
        self.count = len(self._fan.base)
        self._side = np.zeros(self.count, int)
        self._pose = robot.pose
        self._changes = 0

    def block(self, start: float, end: float) -> Block:
        self._move(end)
        before, self._pose = self._pose, self._robot.pose
        share = (np.arange(self._samples) + 1)[:, None] / self._samples
        poses = before + share * (self._pose - before)
        walls = self._robot.walls
        near = walls[segment_distance(walls, before[:2]) < self._fan.reach + 0.05]
        bent = bend_whiskers(self._fan, poses, near, self._side)
        self._side = bent.side[-1]
        changed, self._changes = self._changes != len(self._robot.speeds), len(self._robot.speeds)
        rolls = bool(self._robot.right or self._robot.left)
        if changed and rolls:
            self._shaking.start()
        shake = self._shaking.ring(self._samples) + self._shaking.rumble(self._samples, rolls)
        strain = base_strains(self.config.whiskers, self._fan, bent) + shake[:, None]
        strain += self.config.whiskers.noise * self._random.standard_normal(strain.shape)
        strain = np.where(self._fan.alive[:, None], strain, 0.0)
        angle, begins = np.zeros(strain.shape[:2]), np.zeros(self._samples, bool)
        return Block(angle, strain / self.config.strain_per_radian, begins, fed_back=False)

    def skip_block(self) -> None:
        self._pose = self._robot.pose

    def state(self, now: float) -> dict[str, Any]:
        return {"pose": self._robot.pose.tolist(), "side": self._side.tolist()}
