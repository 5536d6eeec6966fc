"""A head in memory: sends the bytes of a test and records the commands."""

import errno
import json
import threading

import numpy as np

from robot.drivers.head.device import Disconnected, Stalled
from robot.drivers.head.usb_protocol import CHANNELS, Command, Request, pack_frames

WHISKERS = 2


class MemoryHead:
    """A head, and a Bridge to it; `stalls` counts the transfers to refuse next, `clock` is its time, us."""

    def __init__(self, whiskers=WHISKERS):
        self.identity = {"name": "memory", "version": "1", "whiskers": whiskers, "channels": CHANNELS}
        self.identity["rate"] = 2000
        self.plugged, self.stalls, self.clock, self.opened, self.closed = True, 0, 0, 0, 0
        self.commands, self.requests, self._data = [], [], bytearray()
        self._there = threading.Condition()

    def connect(self):
        self._check()
        self.opened += 1
        return self

    def put(self, data):
        with self._there:
            self._data += data
            self._there.notify_all()

    def send(self, first, count=10, values=None, flags=0):
        """Sends frames in order, 500 us apart."""
        number = first + np.arange(count)
        if values is None:
            values = np.zeros((count, WHISKERS, CHANNELS), np.int16)
        self.put(pack_frames(number, 500 * number, np.full(count, flags), values))

    def unplug(self):
        with self._there:
            self.plugged = False
            self._data.clear()
            self._there.notify_all()

    def read(self, size, timeout):
        with self._there:
            self._there.wait_for(lambda: self._data or not self.plugged, timeout)
            self._check()
            data = bytes(self._data[:size])
            del self._data[:size]
            return data

    def write(self, data):
        self._check()
        command = Command.unpack(data)
        assert command is not None
        self.commands.append(command)

    def request(self, request):
        self._check()
        self.requests.append(request)
        if request == Request.CLOCK:
            return self.clock.to_bytes(8, "little")
        return json.dumps(self.identity).encode() if request == Request.IDENTITY else b""

    def close(self):
        self.closed += 1

    def _check(self):
        if not self.plugged:
            raise Disconnected(errno.ENODEV, "pulled out")
        if self.stalls:
            self.stalls -= 1
            raise Stalled(errno.EPIPE, "refused")
