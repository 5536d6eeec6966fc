"""USB bridge of a head by pyusb: over libusb, or over the socket of an emulator.

Errors: `Disconnected` (the device is absent), `Stalled` (a transfer failed; its endpoint has been cleared),
`InputError` (the user must act).
"""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

from robot.drivers.head import usb_protocol as wire
from robot.drivers.head.driver_config import Address
from robot.drivers.head.emulated_cable import SocketBackend
from robot.drivers.head.usb_protocol import Request
from tactile.base.errors import InputError

T = TypeVar("T")
TIMEOUT = 500
"""Time-out of control requests and commands, ms."""


class Disconnected(OSError):
    """The head is not connected."""


class Stalled(OSError):
    """A transfer failed; the next one may succeed."""


class HeadIdentity(NamedTuple):
    """What a head says of itself.

    Attributes:
        name, version: of the bridge. whiskers, channels: of a frame. rate: samples per second.
    """

    name: str
    version: str
    whiskers: int
    channels: int
    rate: float

    @classmethod
    def read(cls, bridge: Bridge) -> HeadIdentity:
        """Asks the device behind a bridge for its identity.

        Raises:
            Disconnected, Stalled. InputError: the device is not a head.
        """
        answer = bridge.request(Request.IDENTITY)
        try:
            fields = json.loads(answer)
            size = int(fields["whiskers"]), int(fields["channels"])
            return cls(str(fields["name"]), str(fields["version"]), *size, float(fields["rate"]))
        except (ValueError, KeyError, TypeError):
            found, cure = f"identity {answer[:80]!r}", "check the address, or the bridge's firmware"
            raise InputError("head", found, "name, version, shape, rate", cure) from None


def open_bridge(address: str) -> Bridge:
    """Opens the bridge at an address (`HeadLinkConfig.address`).

    Raises:
        Disconnected: no such device. InputError: library or permission missing, or device in use.
    """
    where = Address.parse(address)
    core = _pyusb()
    backend = _libusb() if where.host is None else SocketBackend(where.host, where.port)

    def matches(device: Any) -> bool:
        try:
            return where.serial is None or device.serial_number == where.serial
        except (ValueError, core.USBError):  # without permission or serial number it is another device
            return False

    try:
        numbers = {"idVendor": where.vendor, "idProduct": where.product}
        found = core.find(backend=backend, custom_match=matches, **numbers)
        if found is None:
            raise Disconnected(errno.ENODEV, f"no head at {where}")
        return Bridge(found, str(where))
    except core.USBError as error:
        raise _translate(error, str(where)) from error


class Bridge:
    """Connection to a head: a pyusb device, whose interface it claims. Used by one thread at a time.

    All methods raise `Disconnected` or `Stalled`. Another bridge needs the same four.
    """

    def __init__(self, device: Any, where: str) -> None:
        self._device, self._where = device, where
        # Setting a configuration resets a running device, so it is set only if none is active.
        try:
            configured = device.get_active_configuration() is not None
        except _pyusb().USBError:
            configured = False
        if not configured:
            device.set_configuration()
        from usb import util

        util.claim_interface(device, wire.INTERFACE)

    def read(self, size: int, timeout: float) -> bytes:
        """Reads at most `size` bytes of the stream; none if none arrive within `timeout` s."""
        patience = max(1, round(1000 * timeout))
        got = self._try(lambda: self._device.read(wire.ENDPOINT_IN, size, patience), wire.ENDPOINT_IN)
        return b"" if got is None else got.tobytes()

    def write(self, data: bytes) -> None:
        """Sends a command."""
        if self._try(lambda: self._device.write(wire.ENDPOINT_OUT, data, TIMEOUT), wire.ENDPOINT_OUT) is None:
            raise Stalled(errno.ETIMEDOUT, "commands are not accepted")

    def request(self, request: Request) -> bytes:
        """Sends a control request and returns the answer; `Stalled` if it is unknown or not answered."""
        kind = wire.REQUEST_IN
        content: int | bytes = 8 if request == Request.CLOCK else wire.MAX_ANSWER  # size of the answer
        if request in (Request.START, Request.STOP):
            kind, content = wire.REQUEST_OUT, b""
        answer = self._try(lambda: self._device.ctrl_transfer(kind, request, 0, 0, content, TIMEOUT))
        if answer is None:
            raise Stalled(errno.ETIMEDOUT, f"no answer to {request.name}")
        return b"" if isinstance(answer, int) else answer.tobytes()

    def close(self) -> None:
        """Releases the device."""
        from usb import util

        util.dispose_resources(self._device)

    def _try(self, action: Callable[[], T], endpoint: int | None = None) -> T | None:
        """Result of a transfer; None after its time-out."""
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
    """Translates a USBError."""
    if error.errno == errno.EACCES:
        cure = "add a udev rule, see robot/drivers/head/README.md"
        return InputError("head", f"no permission to open {where}", "", cure)
    if error.errno == errno.EBUSY:
        return InputError("head", f"{where} is in use", "", "end the other program that uses it")
    if error.errno == errno.EPIPE:
        return Stalled(errno.EPIPE, f"{where} refused a transfer")
    # EIO and similar: returned while a device is being pulled out, just before ENODEV.
    if error.errno in (errno.ENODEV, errno.ENOENT, errno.ENXIO, errno.ESHUTDOWN, errno.EPROTO, errno.EIO):
        return Disconnected(errno.ENODEV, f"{where} was disconnected")
    return Stalled(error.errno or errno.EIO, f"{where}: {error}")


def _pyusb() -> Any:
    try:
        import usb.core
    except ImportError:
        raise InputError("usb", "not installed", "pyusb", "pip install 'ratslam[live]'") from None
    return usb.core


def _libusb() -> Any:
    """The libusb backend: of libusb-package, else the system's."""
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
