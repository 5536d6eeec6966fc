"""Linux's usbfs for one device: ioctls of libusb turned into requests to an emulated device.

Numbers and layouts are those of <linux/usbdevice_fs.h> on 64-bit machines. libusb submits transfers as blocks
of its own memory (URBs) and reaps them when they are complete; two threads execute them, one those that
wait for data and one all others. Memory of the client is accessed only while it waits in an ioctl.
"""

from __future__ import annotations

import errno
import queue
import struct
import threading
from typing import Any

from robot.drivers.head.emulated_cable import IN, Op, UsbConnection

SETINTERFACE, SETCONFIGURATION, GETDRIVER, SUBMIT, DISCARD, REAP, REAP_NOW = 4, 5, 8, 10, 11, 12, 13
CLAIM, RELEASE, RESET, CLEAR, CAPABILITIES, CLAIM_AWAY, SPEED = 15, 16, 20, 21, 26, 27, 31
"""Numbers of the ioctls, without their sizes."""
URB = struct.Struct("<BBxxiI4xQiiiiiIQ")
"""type, endpoint, status, flags, buffer, its length, actual length, ..."""
STATUS, BUFFER, ACTUAL = 4, 16, 28
"""Offsets of fields of a URB."""
CONTROL = 2
"""The type of a URB whose buffer begins with a setup packet."""
SLICE = 50
"""Period at which a waiting transfer checks whether it was discarded, ms."""


class Urb:
    """A transfer in progress.

    Args:
        block: the client's URB in umockdev's memory.
    """

    def __init__(self, block: Any) -> None:
        kind, self.endpoint, _, _, _, self.size, *_ = URB.unpack(bytes(block.retrieve()))
        self.block = block
        self.control = kind == CONTROL
        self.address = block.client_addr
        self.buffer = block.resolve(BUFFER, self.size) if self.size else None
        self.data = bytes(self.buffer.retrieve()) if self.buffer else b""
        self.discarded = False
        self.status, self.count, self.answer = 0, 0, b""

    @property
    def inwards(self) -> bool:
        """Whether the transfer reads, and so may wait for data."""
        return bool(self.endpoint & IN) and not self.control

    def run(self, line: UsbConnection) -> None:
        """Executes the transfer over a connection."""
        try:
            if self.control:
                kind, request, value, index, length = struct.unpack_from("<BBHHH", self.data)
                data = b"" if kind & IN else self.data[8 : 8 + length]
                size = length if kind & IN else 0
                self.answer = line.call(Op.CONTROL, kind, request, value, index, data, size)
                self.count = len(self.answer) or len(data)
            elif self.inwards:
                self.answer = self._waited(line)
                self.count = len(self.answer)
            else:
                line.call(Op.BULK, self.endpoint, data=self.data)
                self.count = len(self.data)
        except OSError as error:
            self.status = -(error.errno or errno.EIO)

    def _waited(self, line: UsbConnection) -> bytes:
        while not self.discarded:
            try:
                return line.call(Op.BULK, self.endpoint, size=self.size, timeout=SLICE)
            except TimeoutError:  # ETIMEDOUT: not yet
                pass
        raise OSError(errno.ENOENT, "discarded")

    def write(self) -> None:
        """Writes the result into the client's memory."""
        if self.answer and self.buffer is not None:
            self.buffer.update(8 if self.control else 0, self.answer)
        self.block.update(STATUS, struct.pack("<i", self.status))
        self.block.update(ACTUAL, struct.pack("<i", self.count))


class Usbfs:
    """The device node of one device while it is plugged in."""

    def __init__(self, host: str, port: int) -> None:
        self._control = UsbConnection(host, port)
        self._queues: dict[bool, queue.Queue[Urb | None]] = {True: queue.Queue(), False: queue.Queue()}
        self._under_way: dict[int, Urb] = {}
        self._done: queue.Queue[Urb] = queue.Queue()
        lines = {True: UsbConnection(host, port), False: self._control}
        for way, line in lines.items():
            threading.Thread(target=self._carry, args=(self._queues[way], line), daemon=True).start()

    def present(self) -> bool:
        """Whether the device has been plugged in since the start."""
        try:
            return bool(self._control.call(Op.DESCRIBE))
        except OSError:
            return False

    def close(self) -> None:
        """Ends the threads."""
        for waiting in self._queues.values():
            waiting.put(None)

    def ioctl(self, client: Any) -> tuple[int, int]:
        """Executes an ioctl; returns its value and errno."""
        number, argument = client.get_request() & 0xFF, client.get_arg()
        try:
            return self._ioctl(number, argument), 0
        except OSError as error:
            return -1, error.errno or errno.EIO

    def reap(self, client: Any, patience: float) -> bool:
        """Answers a reap with a completed transfer; False if there is none within `patience` s."""
        try:
            urb = self._done.get(timeout=patience)
        except queue.Empty:
            return False
        self._under_way.pop(urb.address, None)
        urb.write()
        client.get_arg().resolve(0, 8).set_ptr(0, urb.block)
        return True

    def _carry(self, waiting: queue.Queue[Urb | None], line: UsbConnection) -> None:
        while (urb := waiting.get()) is not None:
            urb.run(line)
            self._done.put(urb)

    def _ioctl(self, number: int, argument: Any) -> int:
        if number == SUBMIT:
            urb = Urb(argument.resolve(0, URB.size))
            self._under_way[urb.address] = urb
            self._queues[urb.inwards].put(urb)
        elif number == DISCARD:
            sought = self._under_way.get(int.from_bytes(bytes(argument.retrieve()), "little"))
            if sought is None:
                raise OSError(errno.EINVAL, "no such transfer")
            sought.discarded = True
        elif number == CAPABILITIES:
            argument.resolve(0, 4).update(0, struct.pack("<I", 0))
        elif number in (CLAIM, CLAIM_AWAY):
            self._control.call(Op.CLAIM)
        elif number == RELEASE:
            self._control.call(Op.RELEASE)
        elif number == CLEAR:
            (endpoint,) = struct.unpack("<I", bytes(argument.resolve(0, 4).retrieve()))
            self._control.call(Op.CLEAR, endpoint)
        elif number == RESET:
            self._control.call(Op.RESET)
        elif number == GETDRIVER:
            raise OSError(errno.ENODATA, "no driver of the kernel")
        elif number == SPEED:
            return 3
        elif number not in (SETINTERFACE, SETCONFIGURATION):
            raise OSError(errno.ENOTTY, "not for this device")
        return 0
