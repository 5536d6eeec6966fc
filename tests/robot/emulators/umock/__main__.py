"""Runs a program with an emulated head on its USB, through the system's libusb and umockdev:

    umockdev-wrapper /usr/bin/python3 -m tests.robot.emulators.umock --host 127.0.0.11 -- PROGRAM ...

umockdev stands in for the kernel; this program turns the ioctls of libusb into requests to
`python -m robot.emulators.head` at that address. Needs Debian's `umockdev gir1.2-umockdev-1.0 python3-gi` and
the interpreter of that package; PROGRAM may use any. It must use the system's libusb: the one in
`libusb-package` gets unplug events from the kernel only. Exits with the exit code of PROGRAM.
"""

from __future__ import annotations

import argparse
import errno
import importlib
import subprocess
import sys
import threading
from typing import Any

from robot.drivers.head.emulated_cable import PORT, Op, UsbConnection
from tests.robot.emulators.umock.usbfs import REAP, REAP_NOW, Usbfs

LOOK = 20
"""Period of the check whether the head is plugged in, ms."""
PATIENCE = 0.002
"""Time that a reap waits, s; without it libusb would poll the node continuously."""


class Bus:
    """A test bed with the head on it while it is plugged in."""

    def __init__(self, testbed: Any, umockdev: Any, host: str, port: int) -> None:
        self._testbed, self._umockdev = testbed, umockdev
        self._host, self._port = host, port
        self._number = 1  # device number on the bus; each plugging in gives a new one
        self._node: Usbfs | None = None
        self._path = ""

    def look(self) -> bool:
        """Updates the bus; returns True, so that the timer continues."""
        if self._node is not None and not self._node.present():
            self._remove()
        if self._node is None and (descriptors := self._read_descriptors()):
            self._add(descriptors)
        return True

    def _read_descriptors(self) -> bytes:
        try:
            line = UsbConnection(self._host, self._port)
        except OSError:
            return b""
        try:
            return line.call(Op.DESCRIBE)
        except OSError:
            return b""
        finally:
            line.close()

    def _add(self, descriptors: bytes) -> None:
        try:
            node = Usbfs(self._host, self._port)
        except OSError:  # unplugged in the meantime
            return
        self._number += 1
        self._testbed.add_from_string(_description(self._number, descriptors))
        self._path = _path(self._number)
        handler = self._umockdev.IoctlBase()
        handler.connect("handle-ioctl", lambda _, client: _handle(node, client))
        self._testbed.attach_ioctl(_name(self._number), handler)
        self._node, self._handler = node, handler
        self._testbed.uevent(f"/sys{self._path}", "add")

    def _remove(self) -> None:
        assert self._node is not None
        self._testbed.uevent(f"/sys{self._path}", "remove")
        self._testbed.detach_ioctl(_name(self._number))
        self._testbed.remove_device(f"/sys{self._path}")
        self._node.close()
        self._node = None


def _handle(node: Usbfs, client: Any) -> bool:
    number = client.get_request() & 0xFF
    if number in (REAP, REAP_NOW):
        done = node.reap(client, PATIENCE)
        client.complete(*((0, 0) if done else (-1, errno.EAGAIN)))
    else:
        client.complete(*node.ioctl(client))
    return True


def _path(number: int) -> str:
    return f"/devices/pci0000:00/0000:00:14.0/usb1/1-{number}"


def _name(number: int) -> str:
    return f"/dev/bus/usb/001/{number:03d}"


def _description(number: int, descriptors: bytes) -> str:
    """Description of a device for umockdev."""
    vendor, product = (int.from_bytes(descriptors[k : k + 2], "little") for k in (8, 10))
    return "\n".join(
        [
            f"P: {_path(number)}",
            f"N: {_name(number).removeprefix('/dev/')}",
            f"E: DEVNAME={_name(number)}",
            "E: DEVTYPE=usb_device",
            "E: SUBSYSTEM=usb",
            "E: BUSNUM=001",
            f"E: DEVNUM={number:03d}",
            "E: MAJOR=189",
            f"E: MINOR={number - 1}",
            f"E: PRODUCT={vendor:x}/{product:x}/100",
            "A: bConfigurationValue=1\\n",
            "A: busnum=1\\n",
            f"A: devnum={number}\\n",
            "A: speed=480\\n",
            f"A: idVendor={vendor:04x}\\n",
            f"A: idProduct={product:04x}\\n",
            f"H: descriptors={descriptors.hex().upper()}",
            "",
        ]
    )


def main() -> int:
    """Runs the program; returns the client's exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.robot.emulators.umock", description=__doc__)
    parser.add_argument("--host", default="127.0.0.1", help="address of the emulated head")
    parser.add_argument("--port", type=int, default=PORT)
    parser.add_argument("program", nargs="+")
    arguments = parser.parse_args()
    gi = importlib.import_module("gi")
    gi.require_version("UMockdev", "1.0")
    umockdev, glib = (importlib.import_module(f"gi.repository.{name}") for name in ("UMockdev", "GLib"))

    bus = Bus(umockdev.Testbed.new(), umockdev, arguments.host, arguments.port)
    bus.look()
    loop = glib.MainLoop()
    glib.timeout_add(LOOK, bus.look)
    with subprocess.Popen(arguments.program) as client:

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
    sys.exit(main())
