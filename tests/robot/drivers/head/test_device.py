"""The USB bridge: translation of pyusb's errors, addresses, missing libraries."""

from __future__ import annotations

import errno
import sys
from array import array
from unittest.mock import Mock, call

import pytest

from robot.drivers.head.device import Bridge, Disconnected, HeadIdentity, Stalled, open_bridge
from robot.drivers.head.driver_config import Address, HeadLinkConfig
from robot.drivers.head.usb_protocol import ENDPOINT_IN, ENDPOINT_OUT, REQUEST_IN, REQUEST_OUT, Request
from tactile.base.errors import InputError
from tests.robot.drivers.head.memory import MemoryHead

usb = pytest.importorskip("usb.core", reason="pyusb is not installed")


@pytest.fixture
def device(monkeypatch):
    """A pyusb device whose transfers succeed."""
    import usb.util

    monkeypatch.setattr(usb.util, "claim_interface", lambda device, number: None)
    device = Mock()
    device.read.return_value = array("B", b"abc")
    device.ctrl_transfer.side_effect = lambda kind, *_: array("B", bytes(8)) if kind == REQUEST_IN else 0
    return device


def test_transfers(device):
    bridge = Bridge(device, "usb:here")
    assert bridge.read(4096, 0.02) == b"abc"
    bridge.write(b"command")
    assert bridge.request(Request.CLOCK) == bytes(8)
    assert bridge.request(Request.START) == b""
    assert device.mock_calls == [
        call.get_active_configuration(),  # a configured device is not configured again
        call.read(ENDPOINT_IN, 4096, 20),
        call.write(ENDPOINT_OUT, b"command", 500),
        call.ctrl_transfer(REQUEST_IN, Request.CLOCK, 0, 0, 8, 500),
        call.ctrl_transfer(REQUEST_OUT, Request.START, 0, 0, b"", 500),
    ]
    device.get_active_configuration.side_effect = usb.USBError("none", None, errno.ENOENT)
    Bridge(device, "here")
    device.set_configuration.assert_called_once_with()


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (errno.ETIMEDOUT, Stalled),
        (errno.ENODEV, Disconnected),
        (errno.EIO, Disconnected),
        (errno.ENOENT, Disconnected),
        (errno.ENXIO, Disconnected),
        (errno.ESHUTDOWN, Disconnected),
        (errno.EPROTO, Disconnected),
        (errno.EPIPE, Stalled),
        (errno.EOVERFLOW, Stalled),
        (errno.EACCES, InputError),
        (errno.EBUSY, InputError),
    ],
)
def test_translation_of_usb_errors(device, number, kind):
    """A read that times out has read nothing; a command or request has failed."""
    bridge, late = Bridge(device, "usb:here"), number == errno.ETIMEDOUT
    error = (usb.USBTimeoutError if late else usb.USBError)("as libusb says", None, number)
    for transfer in (device.read, device.write, device.ctrl_transfer):
        transfer.side_effect = error
    actions = [lambda: bridge.write(b"x"), lambda: bridge.request(Request.START)]
    if late:
        assert bridge.read(4096, 0.02) == b""
    else:
        actions.insert(0, lambda: bridge.read(4096, 0.02))
    for action in actions:
        with pytest.raises(kind):
            action()
    cleared = [ENDPOINT_IN, ENDPOINT_OUT] if kind is Stalled and not late else []
    assert device.clear_halt.mock_calls == [call(endpoint) for endpoint in cleared]


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
    with pytest.raises((Disconnected, InputError)):  # with a real libusb: no head or no permission
        open_bridge("usb:1209:0001:there-is-none")


def test_the_error_for_a_missing_library_has_a_cure(monkeypatch):
    from usb.backend import libusb1

    monkeypatch.setattr(libusb1, "get_backend", lambda find_library=None: None)
    with pytest.raises(InputError, match="libusb-package"):
        open_bridge("usb")
    monkeypatch.setitem(sys.modules, "usb", None)
    monkeypatch.setitem(sys.modules, "usb.core", None)
    with pytest.raises(InputError, match=r"ratslam\[live\]"):
        open_bridge("usb")


def test_identities():
    bridge = MemoryHead(18)
    assert HeadIdentity.read(bridge) == HeadIdentity("memory", "1", 18, 3, 2000.0)
    for wrong in (b"", b"[]", b"{}", b'{"name": 1', b'{"name":"","version":"","whiskers":null}'):
        bridge.request = lambda request, wrong=wrong: wrong
        with pytest.raises(InputError, match="identity"):
            HeadIdentity.read(bridge)
