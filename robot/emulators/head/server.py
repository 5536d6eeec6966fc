"""The process of an emulated head: samples in real time; USB and faults on sockets.

A single thread, so no locks are needed. Deadlines are absolute: after a delay all blocks that are due are
made, with transfers served in between.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

from robot.drivers.head.emulated_cable import ANSWER, IN, REQUEST, Op, usb_error
from robot.drivers.head.usb_protocol import ENDPOINT_IN
from robot.drivers.processes import urgent
from robot.drivers.ur10.rtde_protocol import PoseListener
from robot.emulators.head.emulated_device import DESCRIPTORS, EmulatedHead
from robot.emulators.head.emulator_config import BridgeEmulatorConfig, HeadEmulatorConfig
from robot.emulators.head.whiskers import AlongPath, CarriedByArm, PoseSource, Whiskers
from robot.emulators.listening import answer_fault, open_ports
from robot.world.scene import HeadPath, KidnapConfig, make_scene
from tactile.whisker_geometry import ur10_head

FaultHandler = Callable[[dict[str, Any], float], dict[str, Any]]


def serve(config: HeadEmulatorConfig) -> None:
    """Serves a head until the process ends; prints `ready` when it listens.

    Raises:
        InputError: invalid maze or path, or the address cannot be used.
    """
    head = ur10_head(config.head)
    made = make_scene(config.maze, config.path, config.motion, KidnapConfig(), head, config.seed)
    with contextlib.ExitStack() as stack:
        place: PoseSource
        if config.arm is None:
            path = made.path
            place = AlongPath(path if config.follow else HeadPath(path.time[:1], path.pose[:1]))
        else:
            arm = PoseListener(config.arm, hz=config.arm_hz)
            stack.callback(arm.close)
            place = CarriedByArm(arm, config.placing)
        whiskers = Whiskers(config, made.surroundings.walls, place)
        stack.enter_context(urgent())  # not before: building takes a core
        asyncio.run(_run_server(config, EmulatedHead(config, whiskers, time.monotonic())))


async def _run_server(config: HeadEmulatorConfig, bridge: EmulatedHead) -> None:
    async with open_server(config, bridge, bridge.do) as server:
        print("ready", flush=True)
        await server.run()


@contextlib.asynccontextmanager
async def open_server(
    config: BridgeEmulatorConfig, bridge: EmulatedHead, do: FaultHandler
) -> AsyncIterator[_HeadServer]:
    """A server of the USB and of the fault requests of an emulated bridge, which listens.

    Args:
        do: executes a fault request at a time, s, and returns the answer.
    """
    server = _HeadServer(bridge, do)
    ports = ((server.usb, config.port), (server.faults, config.control_port))
    async with open_ports(config.host, config.open_to_network, ports):
        yield server


class _HeadServer:
    """Connections of clients to the emulated head."""

    def __init__(self, bridge: EmulatedHead, do: FaultHandler) -> None:
        self.bridge, self._do = bridge, do
        self._changed = asyncio.Event()
        self._owner: tuple[object, int] | None = None  # connection and plug count

    async def run(self) -> None:
        """Makes blocks when they are due."""
        while True:
            if self.bridge.advance(time.monotonic()):
                self._notify()
                await asyncio.sleep(0)
            else:
                await asyncio.sleep(self.bridge.due - time.monotonic())

    async def usb(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serves a connection of `robot.drivers.head.emulated_cable` until the head is unplugged."""
        plugs = self.bridge.faults.plugs
        try:
            while True:
                header = REQUEST.unpack(await reader.readexactly(REQUEST.size))
                op, address, *_, length = header
                takes = op in (Op.CONTROL, Op.BULK) and not address & IN
                data = await reader.readexactly(length) if takes else b""
                try:
                    status, answer = 0, await self._answer(header, data, plugs, writer)
                except OSError as error:
                    status, answer = -(error.errno or errno.EIO), b""
                writer.write(ANSWER.pack(status, len(answer)) + answer)
                await writer.drain()
        finally:
            self._release(writer)

    async def faults(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Executes fault requests: one JSON line each, answered by one JSON line."""
        while line := await reader.readline():
            writer.write(answer_fault(line, lambda request: self._do(request, time.monotonic())))
            self._notify()
            await writer.drain()

    async def _answer(self, header: tuple[int, ...], data: bytes, plugs: int, connection: object) -> bytes:
        op, address, request, value, _, timeout, length = header
        bridge, now = self.bridge, time.monotonic()
        self._present(plugs)
        if op == Op.DESCRIBE:
            return DESCRIPTORS
        if op == Op.CLAIM:
            if self._owner is not None and self._owner[0] is not connection and self._owner[1] == plugs:
                raise usb_error(errno.EBUSY)
            self._owner = connection, plugs
        elif op == Op.RELEASE:
            self._release(connection)
        elif op == Op.CONTROL:
            return bridge.control(address, request, value, length, now)
        elif op == Op.BULK and address == ENDPOINT_IN:
            return await self._frames(length, timeout, plugs)
        elif op == Op.BULK:
            bridge.bulk_out(data, now)
        elif op == Op.CLEAR:
            if address == ENDPOINT_IN:
                bridge.faults.clear_halt()
        elif op == Op.RESET:
            bridge.halt()
        else:
            raise usb_error(errno.EINVAL)
        return b""

    async def _frames(self, size: int, timeout: int, plugs: int) -> bytes:
        """Waits for frames and returns at most `size` bytes of them.

        Args:
            timeout: ms, 0 for none.
        """
        end = time.monotonic() + timeout / 1000 if timeout else float("inf")
        while True:
            self._present(plugs)
            now = time.monotonic()
            if got := self.bridge.bulk_in(size, now):
                return got
            if now >= end:
                raise usb_error(errno.ETIMEDOUT)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._changed.wait(), min(end - now, 1.0))

    def _present(self, plugs: int) -> None:
        faults = self.bridge.faults
        if not faults.plugged or plugs != faults.plugs:
            raise usb_error(errno.ENODEV)

    def _release(self, connection: object) -> None:
        if self._owner is not None and self._owner[0] is connection:
            self._owner = None

    def _notify(self) -> None:
        """Wakes connections that wait for frames."""
        self._changed.set()
        self._changed.clear()
