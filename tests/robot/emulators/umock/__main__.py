"""Runs a program with an emulated head on its USB, through the system's libusb and umockdev:

    umockdev-wrapper /usr/bin/python3 -m tests.robot.emulators.umock HOST PORT PROGRAM ...

umockdev stands in for the kernel; this program turns the ioctls of libusb into requests to
`python -m robot.emulators.head` at that address. Needs Debian's `umockdev gir1.2-umockdev-1.0 python3-gi` and
the interpreter of that package; PROGRAM may use any. It must use the system's libusb: the one in
`libusb-package` gets unplug events from the kernel only. Exits with the exit code of PROGRAM.

Numbers and layouts are those of <linux/usbdevice_fs.h> on 64-bit machines. libusb submits transfers as blocks
of its own memory (URBs) and reaps them when they are complete; two threads execute them, one those that
wait for data and one all others. Memory of the client is accessed only while it waits in an ioctl.
"""

import contextlib
import errno
import importlib
import queue
import struct
import subprocess
import sys
import threading
from typing import Any

from robot.drivers.head.emulated_cable import IN, Op, UsbConnection

LOOK = 20
"""Period of the check whether the head is plugged in, ms."""
PATIENCE = 0.002
"""Time that a reap waits, s; without it libusb would poll the node continuously."""
SLICE = 50
"""Period at which a waiting transfer checks whether it was discarded, ms."""
SETINTERFACE, SETCONFIGURATION, GETDRIVER, SUBMIT, DISCARD, REAP, REAP_NOW = 4, 5, 8, 10, 11, 12, 13
CLAIM, RELEASE, RESET, CLEAR, CAPABILITIES, CLAIM_AWAY, SPEED = 15, 16, 20, 21, 26, 27, 31
"""Numbers of the ioctls, without their sizes."""
URB = struct.Struct("<BBxxiI4xQiiiiiIQ")
"""type, endpoint, status, flags, buffer, its length, actual length, ..."""
STATUS, BUFFER, ACTUAL = 4, 16, 28
"""Offsets of fields of a URB."""
CONTROL = 2
"""The type of a URB whose buffer begins with a setup packet."""
DEVICE = """P: {path}
N: bus/usb/001/{number:03d}
E: DEVNAME=/dev/bus/usb/001/{number:03d}
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
E: BUSNUM=001
E: DEVNUM={number:03d}
E: MAJOR=189
E: MINOR={number}
E: PRODUCT={vendor:x}/{product:x}/100
A: bConfigurationValue=1\\n
A: busnum=1\\n
A: devnum={number}\\n
A: speed=480\\n
A: idVendor={vendor:04x}\\n
A: idProduct={product:04x}\\n
H: descriptors={descriptors}
"""
"""A device in umockdev's words."""


class Urb:
    """A transfer in progress; `block` is the client's URB in umockdev's memory."""

    def __init__(self, block: Any) -> None:
        kind, self.endpoint, _, _, _, self.size, *_ = URB.unpack(bytes(block.retrieve()))
        self.block, self.address, self.control = block, block.client_addr, kind == CONTROL
        self.buffer = block.resolve(BUFFER, self.size) if self.size else None
        self.data = bytes(self.buffer.retrieve()) if self.buffer else b""
        self.waits = bool(self.endpoint & IN) and not self.control  # it reads, and may wait for data
        self.discarded = False
        self.status, self.count, self.answer = 0, 0, b""

    def run(self, line: UsbConnection) -> None:
        """Executes the transfer over a connection."""
        try:
            if self.control:
                kind, request, value, index, length = struct.unpack_from("<BBHHH", self.data)
                data = b"" if kind & IN else self.data[8 : 8 + length]
                size = length if kind & IN else 0
                self.answer = line.call(Op.CONTROL, kind, request, value, index, data, size)
                self.count = len(self.answer) or len(data)
            elif self.waits:
                self.answer = self._waited(line)
                self.count = len(self.answer)
            else:
                line.call(Op.BULK, self.endpoint, data=self.data)
                self.count = len(self.data)
        except OSError as error:
            self.status = -(error.errno or errno.EIO)

    def _waited(self, line: UsbConnection) -> bytes:
        while not self.discarded:
            with contextlib.suppress(TimeoutError):  # ETIMEDOUT: not yet
                return line.call(Op.BULK, self.endpoint, size=self.size, timeout=SLICE)
        raise OSError(errno.ENOENT, "discarded")

    def write(self) -> None:
        """Writes the result into the client's memory."""
        if self.answer and self.buffer is not None:
            self.buffer.update(8 if self.control else 0, self.answer)
        self.block.update(STATUS, struct.pack("<i", self.status))
        self.block.update(ACTUAL, struct.pack("<i", self.count))


class Node:
    """The device node of one device while it is plugged in."""

    def __init__(self, host: str, port: int) -> None:
        self._line = UsbConnection(host, port)
        self._queues: dict[bool, queue.Queue[Urb | None]] = {True: queue.Queue(), False: queue.Queue()}
        self._under_way: dict[int, Urb] = {}
        self._done: queue.Queue[Urb] = queue.Queue()
        for waits, line in ((True, UsbConnection(host, port)), (False, self._line)):
            threading.Thread(target=self._carry, args=(self._queues[waits], line), daemon=True).start()

    def descriptors(self) -> bytes:
        """Descriptors of the device; none once it was unplugged."""
        try:
            return self._line.call(Op.DESCRIBE)
        except OSError:
            return b""

    def close(self) -> None:
        """Ends the threads."""
        for waiting in self._queues.values():
            waiting.put(None)

    def handle(self, _: Any, client: Any) -> bool:
        """Executes an ioctl."""
        number, argument = client.get_request() & 0xFF, client.get_arg()
        try:
            client.complete(self._ioctl(number, argument), 0)
        except OSError as error:
            client.complete(-1, error.errno or errno.EIO)
        return True

    def _carry(self, waiting: queue.Queue[Urb | None], line: UsbConnection) -> None:
        while (urb := waiting.get()) is not None:
            urb.run(line)
            self._done.put(urb)

    def _ioctl(self, number: int, argument: Any) -> int:
        if number in (REAP, REAP_NOW):
            try:
                urb = self._done.get(timeout=PATIENCE)
            except queue.Empty:
                raise OSError(errno.EAGAIN, "none is complete") from None
            self._under_way.pop(urb.address, None)
            urb.write()
            argument.resolve(0, 8).set_ptr(0, urb.block)
        elif number == SUBMIT:
            urb = Urb(argument.resolve(0, URB.size))
            self._under_way[urb.address] = urb
            self._queues[urb.waits].put(urb)
        elif number == DISCARD:
            sought = self._under_way.get(int.from_bytes(bytes(argument.retrieve()), "little"))
            if sought is None:
                raise OSError(errno.EINVAL, "no such transfer")
            sought.discarded = True
        elif number == CAPABILITIES:
            argument.resolve(0, 4).update(0, struct.pack("<I", 0))
        elif number in (CLAIM, CLAIM_AWAY, RELEASE, RESET):
            self._line.call({RELEASE: Op.RELEASE, RESET: Op.RESET}.get(number, Op.CLAIM))
        elif number == CLEAR:
            (endpoint,) = struct.unpack("<I", bytes(argument.resolve(0, 4).retrieve()))
            self._line.call(Op.CLEAR, endpoint)
        elif number == GETDRIVER:
            raise OSError(errno.ENODATA, "no driver of the kernel")
        elif number == SPEED:
            return 3
        elif number not in (SETINTERFACE, SETCONFIGURATION):
            raise OSError(errno.ENOTTY, "not for this device")
        return 0


class Bus:
    """A test bed with the head on it while it is plugged in."""

    def __init__(self, umockdev: Any, host: str, port: int) -> None:
        self._testbed, self._umockdev, self._address = umockdev.Testbed.new(), umockdev, (host, port)
        self._number = 1  # device number on the bus; each plugging in gives a new one
        self._node: Node | None = None

    @property
    def _path(self) -> str:
        return f"/devices/pci0000:00/0000:00:14.0/usb1/1-{self._number}"

    @property
    def _name(self) -> str:
        return f"/dev/bus/usb/001/{self._number:03d}"

    def look(self) -> bool:
        """Updates the bus; returns True, so that the timer continues."""
        if self._node is not None and not self._node.descriptors():
            self._testbed.uevent(f"/sys{self._path}", "remove")
            self._testbed.detach_ioctl(self._name)
            self._testbed.remove_device(f"/sys{self._path}")
            self._node.close()
            self._node = None
        if self._node is None:
            with contextlib.suppress(OSError):  # nothing is plugged in
                self._add(Node(*self._address))
        return True

    def _add(self, node: Node) -> None:
        found = node.descriptors()
        if not found:  # unplugged in the meantime
            node.close()
            return
        self._number += 1
        vendor, product = struct.unpack_from("<HH", found, 8)
        fields = {"path": self._path, "number": self._number, "descriptors": found.hex().upper()}
        self._testbed.add_from_string(DEVICE.format(vendor=vendor, product=product, **fields))
        handler = self._umockdev.IoctlBase()
        handler.connect("handle-ioctl", node.handle)
        self._testbed.attach_ioctl(self._name, handler)
        self._node, self._handler = node, handler
        self._testbed.uevent(f"/sys{self._path}", "add")


def main(host: str, port: str, *program: str) -> int:
    """Runs the program; returns its exit code."""
    gi = importlib.import_module("gi")
    gi.require_version("UMockdev", "1.0")
    umockdev, glib = (importlib.import_module(f"gi.repository.{name}") for name in ("UMockdev", "GLib"))
    bus = Bus(umockdev, host, int(port))
    bus.look()
    loop = glib.MainLoop()
    glib.timeout_add(LOOK, bus.look)
    with subprocess.Popen(program) as client:

        def wait() -> None:
            client.wait()
            glib.idle_add(loop.quit)

        threading.Thread(target=wait, daemon=True).start()
        try:
            loop.run()
        finally:
            client.kill()
    return client.returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
