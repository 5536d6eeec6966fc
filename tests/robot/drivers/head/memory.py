"""A head in memory: sends the bytes of a test and records the commands."""

from __future__ import annotations

import errno
import json
import threading

import numpy as np

from robot.drivers.head.device import Disconnected, Stalled
from robot.drivers.head.usb_protocol import CHANNELS, Command, Request, pack_frames

WHISKERS = 2


class MemoryHead:
    """Attributes:
    plugged: whether it is connected. stalls: number of the next transfers to refuse. clock: device time, us.
    commands, requests: received so far. opened, closed: number of connections opened and closed.
    """

    def __init__(self, whiskers: int = WHISKERS, channels: int = CHANNELS) -> None:
        self.identity = {
            "name": "memory",
            "version": "1",
            "whiskers": whiskers,
            "channels": channels,
            "rate": 2000,
        }
        self.plugged, self.stalls, self.clock, self.opened = True, 0, 0, 0
        self.commands: list[Command] = []
        self.requests: list[Request] = []
        self.closed = 0
        self._data = bytearray()
        self._there = threading.Condition()

    def connect(self) -> Wire:
        self.check()
        self.opened += 1
        return Wire(self)

    def put(self, data: bytes) -> None:
        with self._there:
            self._data += data
            self._there.notify_all()

    def send(self, first: int, count: int = 10, values: np.ndarray | None = None, flags: int = 0) -> None:
        """Sends frames in order, 500 us apart."""
        number = first + np.arange(count)
        if values is None:
            values = np.zeros((count, WHISKERS, CHANNELS), np.int16)
        self.put(pack_frames(number, 500 * number, np.full(count, flags), values))

    def unplug(self) -> None:
        with self._there:
            self.plugged = False
            self._data.clear()
            self._there.notify_all()

    def check(self) -> None:
        if not self.plugged:
            raise Disconnected(errno.ENODEV, "pulled out")
        if self.stalls:
            self.stalls -= 1
            raise Stalled(errno.EPIPE, "refused")

    def take(self, size: int, timeout: float) -> bytes:
        with self._there:
            self._there.wait_for(lambda: self._data or not self.plugged, timeout)
            self.check()
            data = bytes(self._data[:size])
            del self._data[:size]
            return data


class Wire:
    """A `robot.drivers.head.device.Bridge`."""

    def __init__(self, head: MemoryHead) -> None:
        self.head = head

    def read(self, size: int, timeout: float) -> bytes:
        return self.head.take(size, timeout)

    def write(self, data: bytes) -> None:
        self.head.check()
        command = Command.unpack(data)
        assert command is not None
        self.head.commands.append(command)

    def request(self, request: Request) -> bytes:
        self.head.check()
        self.head.requests.append(request)
        if request == Request.CLOCK:
            return self.head.clock.to_bytes(8, "little")
        return json.dumps(self.head.identity).encode() if request == Request.IDENTITY else b""

    def close(self) -> None:
        self.head.closed += 1
