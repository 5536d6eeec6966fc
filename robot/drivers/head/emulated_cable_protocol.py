"""USB over TCP: protocol of a connection to an emulated device, and its client.

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
from enum import IntEnum

PORT = 30100
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

    def __init__(self, host: str, port: int = PORT) -> None:
        self._lock = threading.Lock()
        try:
            self._socket = socket.create_connection((host, port), PATIENCE)
        except OSError:
            raise no_device() from None
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
                raise no_device() from None
        if status:
            raise OSError(-status, os.strerror(-status))
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
                raise no_device()
            parts.append(part)
            size -= len(part)
        return b"".join(parts)


def no_device() -> OSError:
    """The error of a transfer to a disconnected device."""
    return OSError(errno.ENODEV, os.strerror(errno.ENODEV))
