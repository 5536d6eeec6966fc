"""The USB bridge: translation of pyusb's errors, addresses, missing libraries."""

from __future__ import annotations

import errno
import subprocess
import sys
from array import array

import pytest

from robot.drivers.head.device import Bridge, Disconnected, HeadIdentity, Stalled, open_bridge
from robot.drivers.head.driver_config import Address, HeadLinkConfig
from robot.drivers.head.usb_protocol import ENDPOINT_IN, ENDPOINT_OUT, REQUEST_IN, REQUEST_OUT, Request
from tactile.base.errors import InputError
from tests.robot.drivers.head.memory import MemoryHead

usb = pytest.importorskip("usb.core", reason="pyusb is not installed")


class Device:
    """A pyusb device whose transfers succeed, or raise `error`."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error = error
        self.calls: list[tuple] = []
        self.configured = True

    def _end(self, *call):
        self.calls.append(call)
        if self.error is not None:
            raise self.error

    def read(self, endpoint, size, timeout):
        self._end("read", endpoint, size, timeout)
        return array("B", b"abc")

    def write(self, endpoint, data, timeout):
        self._end("write", endpoint, bytes(data))
        return len(data)

    def ctrl_transfer(self, kind, request, value, index, data, timeout):
        self._end("control", kind, request, data)
        return array("B", bytes(8)) if kind == REQUEST_IN else 0

    def clear_halt(self, endpoint):
        self.calls.append(("clear", endpoint))

    def get_active_configuration(self):
        if not self.configured:
            raise usb.USBError("none", None, errno.ENOENT)
        return object()

    def set_configuration(self):
        self.calls.append(("configuration",))


@pytest.fixture
def device(monkeypatch):
    import usb.util

    monkeypatch.setattr(usb.util, "claim_interface", lambda device, number: None)
    return Device()


@pytest.fixture
def bridge(device):
    return Bridge(device, "usb:here")


def test_transfers(device, bridge):
    assert bridge.read(4096, 0.02) == b"abc"
    bridge.write(b"command")
    assert bridge.request(Request.CLOCK) == bytes(8)
    assert bridge.request(Request.START) == b""
    assert device.calls == [
        ("read", ENDPOINT_IN, 4096, 20),
        ("write", ENDPOINT_OUT, b"command"),
        ("control", REQUEST_IN, Request.CLOCK, 8),
        ("control", REQUEST_OUT, Request.START, b""),
    ]


def test_a_configured_device_is_not_configured_again(device):
    Bridge(device, "here")
    assert device.calls == []
    device.configured = False
    Bridge(device, "here")
    assert device.calls == [("configuration",)]


def test_a_time_out_is_an_error_only_for_requests_and_commands(device, bridge):
    device.error = usb.USBTimeoutError("late", None, errno.ETIMEDOUT)
    assert bridge.read(4096, 0.02) == b""
    for action in (lambda: bridge.write(b"x"), lambda: bridge.request(Request.CLOCK)):
        with pytest.raises(Stalled):
            action()


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ENODEV, Disconnected),
        (errno.EIO, Disconnected),
        (errno.EPIPE, Stalled),
        (errno.EOVERFLOW, Stalled),
        (errno.EACCES, InputError),
        (errno.EBUSY, InputError),
    ],
)
def test_translation_of_usb_errors(device, bridge, number, kind):
    device.error = usb.USBError("as libusb says", None, number)
    for action in (
        lambda: bridge.read(4096, 0.02),
        lambda: bridge.write(b"x"),
        lambda: bridge.request(Request.START),
    ):
        with pytest.raises(kind):
            action()
    cleared = [call[1] for call in device.calls if call[0] == "clear"]
    assert cleared == ([ENDPOINT_IN, ENDPOINT_OUT] if kind is Stalled else [])


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("usb", Address()),
        ("usb:1d50:60a1", Address(0x1D50, 0x60A1)),
        ("usb:1D50:60a1:A-7", Address(0x1D50, 0x60A1, "A-7")),
        ("127.0.0.11", Address(host="127.0.0.11")),
        ("head.lab:31000", Address(host="head.lab", port=31000)),
    ],
)
def test_addresses(text, address):
    assert Address.parse(text) == address
    assert Address.parse(str(address)) == address
    assert HeadLinkConfig(address=text).address == text


@pytest.mark.parametrize(
    "text", ["", "usb:", "usb:12:34", "usb:1209:0001:", "host:port", "host:70000", "a b", "usbx"]
)
def test_invalid_addresses(text):
    with pytest.raises(ValueError, match="not an address of a head"):
        HeadLinkConfig(address=text)


def test_no_head_at_an_address():
    with pytest.raises(Disconnected, match=r"127\.0\.0\.1:9"):
        open_bridge("127.0.0.1:9")


def test_usb_without_a_head():
    """With a real libusb: no head or no permission, never another exception."""
    with pytest.raises((Disconnected, InputError)):
        open_bridge("usb:1209:0001:there-is-none")


def test_the_error_for_missing_libusb_has_a_cure(monkeypatch):
    from usb.backend import libusb1

    monkeypatch.setattr(libusb1, "get_backend", lambda find_library=None: None)
    with pytest.raises(InputError, match="libusb-package"):
        open_bridge("usb")


def test_the_error_for_missing_pyusb_has_a_cure(monkeypatch):
    monkeypatch.setitem(sys.modules, "usb", None)
    monkeypatch.setitem(sys.modules, "usb.core", None)
    with pytest.raises(InputError, match=r"ratslam\[live\]"):
        open_bridge("usb")


def test_usb_is_imported_lazily():
    code = """
import sys
import robot.drivers.head.device, robot.drivers.head.reader
import robot.drivers.head.whisk_control, robot.drivers.head.driver_config
print([name for name in ("usb", "libusb_package", "jax", "robot.emulators") if name in sys.modules])
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout.strip() == "[]"


def test_identities():
    bridge = MemoryHead(18).connect()
    assert HeadIdentity.read(bridge) == HeadIdentity("memory", "1", 18, 3, 2000.0)
    for wrong in (b"", b"[]", b"{}", b'{"name": 1', b'{"name":"","version":"","whiskers":null}'):
        bridge.request = lambda request, wrong=wrong: wrong
        with pytest.raises(InputError, match="identity"):
            HeadIdentity.read(bridge)
