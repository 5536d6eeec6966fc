"""USB over TCP: what is said on a connection to an emulated device, and the client's end of it.

A client sends requests one after another and waits for each answer, so transfers that may have to wait for
each other take connections of their own. Little-endian:

    request: u8 op | u8 address | u8 request | u8 0 | u16 value | u16 index | u32 timeout, ms | u32 length
             and the data
    answer:  i32 status | u32 length | data

`address` is that of an endpoint, or bmRequestType of a control transfer; its highest bit says that data comes
in, and then the request carries none. The status is 0 or an errno, negative. Only the standard library is
used: interpreters without this project's packages have to speak it too.
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
"""The bit of an address that says that data comes in."""
PATIENCE = 2.0
"""s that an answer may take beyond the time-out of its transfer, before the device counts as gone."""


class Op(IntEnum):
    """What is asked for."""

    DESCRIBE = 0
    """The device's and the configuration's descriptors, as they are on a bus."""
    CLAIM = 1
    """The interface, until released or the connection ends; EBUSY while another has it."""
    RELEASE = 2
    CONTROL = 3
    BULK = 4
    CLEAR = 5
    """The halt of an endpoint."""
    RESET = 6


class UsbConnection:
    """A connection to an emulated device; a thread at a time uses it, others wait.

    Raises:
        OSError: ENODEV where nothing listens, or the device has been unplugged since.
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
        """What a request is answered with.

        Args:
            data: to send. size: bytes wanted, where data comes in. timeout: ms, 0 waits for ever.

        Raises:
            OSError: as the transfer ended; ENODEV when the emulator is gone.
        """
        length = len(data) or size
        with self._lock:
            try:
                self._socket.settimeout(timeout / 1000 + PATIENCE if timeout else None)
                self._socket.sendall(REQUEST.pack(op, address, request, value, index, timeout, length) + data)
                status, length = ANSWER.unpack(self._exactly(ANSWER.size))
                got = self._exactly(length)
            except OSError:
                self._socket.close()  # an answer that comes late would be taken for another's
                raise no_device() from None
        if status:
            raise OSError(-status, os.strerror(-status))
        return got

    def close(self) -> None:
        """Ends it; a thread that waits in `call` gets ENODEV."""
        with contextlib.suppress(OSError):  # the other end may have been faster
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
    """What a transfer to a device that is not there ends with."""
    return OSError(errno.ENODEV, os.strerror(errno.ENODEV))
