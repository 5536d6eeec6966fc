"""USB over TCP to an emulated device: its protocol, its client, and a pyusb backend without kernel or libusb.

A client waits for each answer before the next request, so concurrent transfers need separate connections.
Little-endian:

    request: u8 op | u8 address | u8 request | u8 0 | u16 value | u16 index | u32 timeout, ms | u32 length
             and the data
    answer:  i32 status | u32 length | data

`address` is that of an endpoint, or bmRequestType of a control transfer; its highest bit marks data to the
host; the request then carries none. The status is 0 or a negative errno. Only the standard library is used,
so that interpreters without this project's packages can use it.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import struct
import threading
from array import array
from collections.abc import Callable, Iterator
from enum import IntEnum
from types import SimpleNamespace
from typing import Any, NoReturn, TypeVar

REQUEST, ANSWER = struct.Struct("<BBBxHHII"), struct.Struct("<iI")
IN = 0x80
"""Bit of an address that marks data to the host."""
PATIENCE = 2.0
"""Time beyond a transfer's time-out after which the device counts as disconnected, s."""


class Op(IntEnum):
    """Kinds of request."""

    DESCRIBE = 0
    """The descriptors of device and configuration, as on a bus."""
    CLAIM = 1
    """Claim the interface until release or the end of the connection; EBUSY while claimed by another."""
    RELEASE = 2
    CONTROL = 3
    BULK = 4
    CLEAR = 5
    """Clear the halt of an endpoint."""
    RESET = 6


class UsbConnection:
    """A connection to an emulated device; threads use it in turn.

    Raises:
        OSError: ENODEV without a listener, or after the device was unplugged.
    """

    def __init__(self, host: str, port: int) -> None:
        self._lock = threading.Lock()
        try:
            self._socket = socket.create_connection((host, port), PATIENCE)
        except OSError:
            raise usb_error(errno.ENODEV) from None
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def call(
        self,
        op: Op,
        address: int = 0,
        request: int = 0,
        value: int = 0,
        index: int = 0,
        data: bytes = b"",
        size: int = 0,
        timeout: int = 1000,
    ) -> bytes:
        """Sends a request and returns the answer.

        Args:
            data: to send. size: largest number of bytes to receive. timeout: ms, 0 for none.

        Raises:
            OSError: error of the transfer; ENODEV without an emulator.
        """
        length = len(data) or size
        with self._lock:
            try:
                self._socket.settimeout(timeout / 1000 + PATIENCE if timeout else None)
                self._socket.sendall(REQUEST.pack(op, address, request, value, index, timeout, length) + data)
                status, length = ANSWER.unpack(self._exactly(ANSWER.size))
                got = self._exactly(length)
            except OSError:
                self._socket.close()  # a late answer would be read as that of the next request
                raise usb_error(errno.ENODEV) from None
        if status:
            raise usb_error(-status)
        return got

    def close(self) -> None:
        """Closes the connection; a thread that waits in `call` gets ENODEV."""
        with contextlib.suppress(OSError):  # the other end may have closed first
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _exactly(self, size: int) -> bytes:
        parts = []
        while size:
            part = self._socket.recv(size)
            if not part:
                raise usb_error(errno.ENODEV)
            parts.append(part)
            size -= len(part)
        return b"".join(parts)


def usb_error(number: int) -> OSError:
    """The error of a transfer, by its errno."""
    return OSError(number, os.strerror(number))


T = TypeVar("T")


class _Handle:
    """An open device: one connection for transfers that wait for data, another for all others."""

    def __init__(self, host: str, port: int) -> None:
        self.inwards = UsbConnection(host, port)
        try:
            self.other = UsbConnection(host, port)
        except OSError:
            self.inwards.close()
            raise

    def close(self) -> None:
        self.inwards.close()
        self.other.close()


class SocketBackend:
    """A `usb.backend.IBackend` (by its methods) of a bus with at most one device: an emulator's."""

    def __init__(self, host: str, port: int) -> None:
        self.host, self.port = host, port

    def enumerate_devices(self) -> Iterator[bytes]:
        """Yields the descriptors of the device, which identify it, if it is plugged in."""
        try:
            line = UsbConnection(self.host, self.port)
        except OSError:
            return
        try:
            yield line.call(Op.DESCRIBE)
        except OSError:
            return
        finally:
            line.close()

    def get_parent(self, dev: bytes) -> None:
        """Returns None: the device has no parent."""

    def get_device_descriptor(self, dev: bytes) -> SimpleNamespace:
        names = "bcdUSB bDeviceClass bDeviceSubClass bDeviceProtocol bMaxPacketSize0 idVendor idProduct "
        names += "bcdDevice iManufacturer iProduct iSerialNumber bNumConfigurations"
        whereabouts = {"bus": 1, "address": 1, "port_number": 1, "port_numbers": (1,), "speed": 3}
        return _descriptor("<BBHBBBBHHHBBBB", names, dev, **whereabouts)

    def get_configuration_descriptor(self, dev: bytes, config: int) -> SimpleNamespace:
        _require_first(config)
        names = "wTotalLength bNumInterfaces bConfigurationValue iConfiguration bmAttributes bMaxPower"
        return _descriptor("<BBHBBBBB", names, _descriptors(dev, 2)[0])

    def get_interface_descriptor(self, dev: bytes, intf: int, alt: int, config: int) -> SimpleNamespace:
        _require_first(intf, alt, config)
        names = "bInterfaceNumber bAlternateSetting bNumEndpoints bInterfaceClass bInterfaceSubClass "
        names += "bInterfaceProtocol iInterface"
        return _descriptor("<9B", names, _descriptors(dev, 4)[0])

    def get_endpoint_descriptor(
        self, dev: bytes, ep: int, intf: int, alt: int, config: int
    ) -> SimpleNamespace:
        _require_first(intf, alt, config)
        names = "bEndpointAddress bmAttributes wMaxPacketSize bInterval"
        return _descriptor("<BBBBHB", names, _descriptors(dev, 5)[ep], bRefresh=0, bSynchAddress=0)

    def open_device(self, dev: bytes) -> _Handle:
        return _as_usb_error(lambda: _Handle(self.host, self.port))

    def close_device(self, dev_handle: _Handle) -> None:
        dev_handle.close()

    def set_configuration(self, dev_handle: _Handle, config_value: int) -> None:
        self._request(dev_handle, Op.CONTROL, 0x00, request=9, value=config_value)

    def get_configuration(self, dev_handle: _Handle) -> int:
        return self._request(dev_handle, Op.CONTROL, 0x80, request=8, size=1)[0]

    def set_interface_altsetting(self, dev_handle: _Handle, intf: int, altsetting: int) -> None:
        self._request(dev_handle, Op.CONTROL, 0x01, request=11, value=altsetting, index=intf)

    def claim_interface(self, dev_handle: _Handle, intf: int) -> None:
        self._request(dev_handle, Op.CLAIM)

    def release_interface(self, dev_handle: _Handle, intf: int) -> None:
        self._request(dev_handle, Op.RELEASE)

    def bulk_write(self, dev_handle: _Handle, ep: int, intf: int, data: array, timeout: int) -> int:
        packet = data.tobytes()
        self._request(dev_handle, Op.BULK, ep, data=packet, timeout=timeout)
        return len(packet)

    def bulk_read(self, dev_handle: _Handle, ep: int, intf: int, buff: array, timeout: int) -> int:
        return self._receive(dev_handle, Op.BULK, ep, buff, timeout=timeout)

    def ctrl_transfer(
        self,
        dev_handle: _Handle,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: array,
        timeout: int,
    ) -> int:
        setup = {"request": bRequest, "value": wValue, "index": wIndex, "timeout": timeout}
        if bmRequestType & IN:
            return self._receive(dev_handle, Op.CONTROL, bmRequestType, data, **setup)
        packet = data.tobytes()
        self._request(dev_handle, Op.CONTROL, bmRequestType, data=packet, **setup)
        return len(packet)

    def clear_halt(self, dev_handle: _Handle, ep: int) -> None:
        self._request(dev_handle, Op.CLEAR, ep)

    def reset_device(self, dev_handle: _Handle) -> None:
        self._request(dev_handle, Op.RESET)

    def is_kernel_driver_active(self, dev_handle: _Handle, intf: int) -> bool:
        return False

    def detach_kernel_driver(self, dev_handle: _Handle, intf: int) -> None:
        """Has no effect: there is no kernel driver."""

    def attach_kernel_driver(self, dev_handle: _Handle, intf: int) -> None:
        """Has no effect: there is no kernel driver."""

    def intr_write(self, *transfer: Any) -> NoReturn:
        raise NotImplementedError("interrupt transfers")

    intr_read = iso_write = iso_read = intr_write

    def _request(self, handle: _Handle, op: Op, address: int = 0, **more: Any) -> bytes:
        line = handle.inwards if op == Op.BULK and address & IN else handle.other
        return _as_usb_error(lambda: line.call(op, address, **more))

    def _receive(self, handle: _Handle, op: Op, address: int, buffer: array, **more: Any) -> int:
        """Requests bytes into a buffer; returns their number."""
        place = memoryview(buffer).cast("B")
        got = self._request(handle, op, address, size=len(place), **more)
        place[: len(got)] = got
        return len(got)


def _as_usb_error(action: Callable[[], T]) -> T:
    """Runs an action; translates errors to those of libusb."""
    import usb.core

    try:
        return action()
    except OSError as error:
        kind = usb.core.USBTimeoutError if error.errno == errno.ETIMEDOUT else usb.core.USBError
        raise kind(error.strerror, None, error.errno) from None


def _descriptors(dev: bytes, kind: int) -> list[bytes]:
    """The descriptors of a kind; each starts with its length and kind."""
    found, place = [], 0
    while place < len(dev):
        if dev[place + 1] == kind:
            found.append(dev[place : place + dev[place]])
        place += dev[place]
    return found


def _descriptor(layout: str, names: str, data: bytes, **more: Any) -> SimpleNamespace:
    """A descriptor as pyusb reads it: its length and kind, and the fields of these names."""
    names = f"bLength bDescriptorType {names}"
    fields = dict(zip(names.split(), struct.unpack_from(layout, data), strict=True))
    return SimpleNamespace(**fields, **more, extra_descriptors=[])


def _require_first(*index: int) -> None:
    if any(index):
        raise IndexError(f"descriptor {index}: the device has one of each")
