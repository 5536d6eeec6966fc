"""The bridge between a head and this machine, by pyusb: over libusb, or over an emulator's socket.

What goes wrong has three names: `Disconnected`, the device is not there (any more); `Stalled`, a transfer was
refused, and the endpoint is cleared by now; and `InputError`, nothing changes until the user does something.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeVar

from robot.drivers.head.address import Address
from robot.drivers.head.protocol import (
    ENDPOINT_IN,
    ENDPOINT_OUT,
    INTERFACE,
    MAX_ANSWER,
    REQUEST_IN,
    REQUEST_OUT,
    Request,
)
from tactile.base.errors import InputError

T = TypeVar("T")
TIMEOUT = 500
"""ms for control requests and commands."""


class Disconnected(OSError):
    """The head is not, or no longer, there."""


class Stalled(OSError):
    """A transfer was refused; the next one may go through."""


class HeadIdentity(NamedTuple):
    """Attributes:
    name, version: of the bridge. whiskers, channels: of a frame. rate: samples per second.
    """

    name: str
    version: str
    whiskers: int
    channels: int
    rate: float


class Bridge(Protocol):
    """A head's end of the wire. Used by one thread at a time."""

    def read(self, size: int, timeout: float) -> bytes:
        """Some of the stream, at most so many bytes; none if none come within `timeout` s.

        Raises:
            Gone, Stalled.
        """
        ...

    def write(self, data: bytes) -> None:
        """Sends a command.

        Raises:
            Gone, Stalled: nobody takes it.
        """
        ...

    def request(self, request: Request) -> bytes:
        """The answer to a control request.

        Raises:
            Gone, Stalled: the head does not know it, or does not answer.
        """
        ...

    def close(self) -> None:
        """Lets go of the device."""
        ...


def read_identity(bridge: Bridge) -> HeadIdentity:
    """What is at the other end.

    Raises:
        Gone, Stalled. InputError: it is something else than a head.
    """
    answer = bridge.request(Request.IDENTITY)
    try:
        told = json.loads(answer)
        size = int(told["whiskers"]), int(told["channels"])
        return HeadIdentity(str(told["name"]), str(told["version"]), *size, float(told["rate"]))
    except (ValueError, KeyError, TypeError):
        cure = "check the address, or the bridge's firmware"
        raise InputError(
            "head", f"it calls itself {answer[:80]!r}", "name, version, shape, rate", cure
        ) from None


def open_bridge(address: str) -> Bridge:
    """The bridge at an address as `HeadLinkConfig` has it.

    Raises:
        Gone: none is there. InputError: this machine cannot reach any: libraries, rights, another program.
    """
    where = Address.parse(address)
    core = _pyusb()
    backend = _libusb() if where.host is None else _socket(where.host, where.port)
    try:
        numbers = {"idVendor": where.vendor, "idProduct": where.product}
        found = core.find(backend=backend, custom_match=_serial_filter(where.serial), **numbers)
        if found is None:
            raise Disconnected(errno.ENODEV, f"no head at {where}")
        return UsbBridge(found, str(where))
    except core.USBError as error:
        raise _translate(error, str(where)) from error


class UsbBridge:
    """A device of pyusb as a `Bridge`. Takes its interface for itself."""

    def __init__(self, device: Any, where: str) -> None:
        self._device, self._where = device, where
        self._configured()
        from usb import util

        util.claim_interface(device, INTERFACE)

    def read(self, size: int, timeout: float) -> bytes:
        patience = max(1, round(1000 * timeout))
        got = self._try(lambda: self._device.read(ENDPOINT_IN, size, patience), ENDPOINT_IN)
        return b"" if got is None else got.tobytes()

    def write(self, data: bytes) -> None:
        if self._try(lambda: self._device.write(ENDPOINT_OUT, data, TIMEOUT), ENDPOINT_OUT) is None:
            raise Stalled(errno.ETIMEDOUT, "no command is taken")

    def request(self, request: Request) -> bytes:
        if request in (Request.START, Request.STOP):
            answer = self._try(lambda: self._device.ctrl_transfer(REQUEST_OUT, request, 0, 0, b"", TIMEOUT))
        else:
            size = 8 if request == Request.CLOCK else MAX_ANSWER
            answer = self._try(lambda: self._device.ctrl_transfer(REQUEST_IN, request, 0, 0, size, TIMEOUT))
        if answer is None:
            raise Stalled(errno.ETIMEDOUT, f"no answer to {request.name}")
        return b"" if isinstance(answer, int) else answer.tobytes()

    def close(self) -> None:
        from usb import util

        util.dispose_resources(self._device)

    def _configured(self) -> None:
        # Choosing a configuration resets a device that runs, so only one that has none is given one.
        try:
            configured = self._device.get_active_configuration() is not None
        except _pyusb().USBError:
            configured = False
        if not configured:
            self._device.set_configuration()

    def _try(self, action: Callable[[], T], endpoint: int | None = None) -> T | None:
        """What a transfer gives; None when its time ran out."""
        core = _pyusb()
        try:
            return action()
        except core.USBTimeoutError:
            return None
        except core.USBError as error:
            fault = _translate(error, self._where)
        if isinstance(fault, Stalled) and endpoint is not None:
            try:
                self._device.clear_halt(endpoint)
            except core.USBError as error:
                fault = _translate(error, self._where)
        raise fault


def _translate(error: Any, where: str) -> OSError | InputError:
    """What a USBError is called here."""
    if error.errno == errno.EACCES:
        cure = "allow it by a udev rule, see robot/head/README.md"
        return InputError("head", f"{where} may not be opened by this user", "", cure)
    if error.errno == errno.EBUSY:
        return InputError("head", f"{where} is in use", "", "end the other program that reads it")
    if error.errno == errno.EPIPE:
        return Stalled(errno.EPIPE, f"{where} refused a transfer")
    # EIO and its like: what a device that is being pulled out answers with, just before ENODEV.
    if error.errno in (errno.ENODEV, errno.ENOENT, errno.ENXIO, errno.ESHUTDOWN, errno.EPROTO, errno.EIO):
        return Disconnected(errno.ENODEV, f"{where} is gone")
    return Stalled(error.errno or errno.EIO, f"{where}: {error}")


def _serial_filter(serial: str | None) -> Callable[[Any], bool] | None:
    if serial is None:
        return None

    def matches(device: Any) -> bool:
        try:
            return device.serial_number == serial
        except (ValueError, _pyusb().USBError):  # no rights to ask, or no serial: another device
            return False

    return matches


def _pyusb() -> Any:
    try:
        import usb.core
    except ImportError:
        raise InputError("usb", "not installed", "pyusb", "pip install 'ratslam[live]'") from None
    return usb.core


def _libusb() -> Any:
    """The backend of libusb: the one that the package brings, else the system's."""
    from usb.backend import libusb1

    try:
        import libusb_package
    except ImportError:
        backend = libusb1.get_backend()
    else:
        # pyusb looks for the library at the first call only.
        backend = libusb1.get_backend(find_library=libusb_package.find_library) or libusb1.get_backend()
    if backend is None:
        cure = "pip install libusb-package, or install the system's libusb-1.0"
        raise InputError("usb", "no libusb", "libusb 1.0", cure)
    return backend


def _socket(host: str, port: int) -> Any:
    from robot.drivers.head import usb_tcp_backend

    return usb_tcp_backend.tcp_backend(host, port)
