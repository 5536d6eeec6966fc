"""The line to the Create: a query and its reply, whatever the line does to them."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple, Protocol

from robot.drivers.create import protocol
from tactile.base.errors import InputError

ANSWER = 0.1
"""s within which a reply has to come; a USB adapter holds it back for up to 16 ms."""
QUIET = 0.02
"""s without a byte after which a line has nothing more to say."""


class NoPort(InputError):
    """The serial port cannot be opened."""


class Unplugged(Exception):
    """The port has gone."""


class NoReply(Exception):
    """No reply came."""


class BadReply(Exception):
    """Something came that no Create says."""


class SerialPort(Protocol):
    """What is used of a `serial.Serial`."""

    timeout: float | None

    @property
    def in_waiting(self) -> int: ...
    def read(self, size: int = 1) -> bytes: ...
    def write(self, data: bytes) -> int | None: ...
    def close(self) -> None: ...


class LinkCounts(NamedTuple):
    """What became of the queries.

    Attributes:
        good: replies believed. late: of these, after they had been given up. lost: given up, or in doubt
            because noise came behind it; unless it still came late, the motion it told is lost.
            stray: bytes that belonged to no reply.
    """

    good: int = 0
    late: int = 0
    lost: int = 0
    stray: int = 0

    @property
    def owed(self) -> int:
        """Replies that were lost and have not come late."""
        return self.lost - self.late


def open_port(name: str, *, exclusive: bool = True) -> SerialPort:
    """The serial port, at the Create's speed.

    Raises:
        NoPort: with what is wrong with it.
        InputError: without pyserial.
    """
    try:
        import serial
    except ImportError:
        raise InputError("serial", "pyserial is not installed", "", "pip install 'ratslam[live]'") from None
    # Without `exclusive` pyserial never asks for a lock; False would be refused on Windows.
    options = {"exclusive": True} if exclusive else {}
    try:
        port: SerialPort = serial.Serial(name, protocol.BAUD, timeout=ANSWER, write_timeout=ANSWER, **options)
    except OSError as error:
        raise _explain(name, error) from None
    return port


def _explain(name: str, error: OSError) -> NoPort:
    """The error in words. pyserial tells most causes in its text alone."""
    cause = error.errno or getattr(error.__context__, "errno", None)
    if cause == errno.ENOENT:
        from serial.tools.list_ports import comports

        ports = ", ".join(sorted(port.device for port in comports())) or "none; plug the cable in"
        return NoPort(name, "there is no such port", f"one of those there are: {ports}")
    if cause == errno.EACCES:
        return NoPort(name, "may not be opened", "", "join its group: sudo usermod -aG dialout $USER")
    if cause in (errno.EAGAIN, errno.EBUSY):
        return NoPort(name, "is held by another program", "", "end that program")
    return NoPort(name, f"cannot be opened ({error})", "a serial port")


def _replies(data: bytes, elapsed: float, most: int) -> list[protocol.SensorReply]:
    """All of the bytes as replies, oldest first, the last `most`; or else the end of them as one, or none."""
    size = protocol.REPLY.size
    pieces = [protocol.parse_reply(data[i : i + size], elapsed) for i in range(0, len(data), size)]
    believed = [piece for piece in pieces if piece is not None]
    if len(believed) == len(pieces):
        return believed[-most:]
    last = protocol.parse_reply(data[-size:], elapsed)
    return [] if last is None else [last]


class SerialLink:
    """Query and reply.

    Replies carry no mark, and a reply clears what it tells. So one that comes after it was given up is
    added to the next, and of a disturbed one the end is looked at: noise mostly stands before it.
    """

    def __init__(self, port: SerialPort) -> None:
        self._port = port
        self._late_motion = (0, 0)
        self.counts = LinkCounts()

    def send(self, command: bytes) -> None:
        """Writes a whole command."""
        with self._attached():
            self._port.write(command)

    def ask(self, elapsed: float) -> protocol.SensorReply:
        """What is sensed now.

        Args:
            elapsed: s since the last reply; inf if there was none.

        Raises:
            Silent, Garbled, Unplugged: no reply that can be believed.
        """
        with self._attached():
            self._catch_up(elapsed)
            self._port.timeout = ANSWER
            self._port.write(protocol.QUERY)
            data = self._port.read(protocol.REPLY.size)
            # Noise and the beginning of a reply can look like one: then there is more.
            if data and (self._port.in_waiting or protocol.parse_reply(data, elapsed) is None):
                data += self._rest()
        found = _replies(data, elapsed, 1 + self.counts.owed)
        if not found:
            self._count(lost=1, stray=len(data))
            raise BadReply(f"{len(data)} bytes: {data[:8].hex(' ')}") if data else NoReply("no reply")
        self._accept(found, late=len(found) - 1, stray=len(data) - protocol.REPLY.size * len(found))
        (millimetres, degrees), self._late_motion = self._late_motion, (0, 0)
        return found[-1]._replace(millimetres=millimetres, degrees=degrees)

    def close(self) -> None:
        """Gives the port back."""
        self._port.close()

    def _catch_up(self, elapsed: float) -> None:
        """Takes what came after it was given up. Anything else casts doubt on the reply before it."""
        data = self._port.read(self._port.in_waiting) if self._port.in_waiting else b""
        owed = self.counts.owed
        found = _replies(data, elapsed, owed) if owed else []
        self._accept(found, late=len(found), stray=len(data) - protocol.REPLY.size * len(found))
        self._count(lost=int(bool(data) and not found))

    def _accept(self, found: list[protocol.SensorReply], *, late: int, stray: int) -> None:
        self._late_motion = (
            self._late_motion[0] + sum(reply.millimetres for reply in found),
            self._late_motion[1] + sum(reply.degrees for reply in found),
        )
        self._count(good=len(found), late=late, stray=stray)

    def _rest(self) -> bytes:
        """Everything until the line is quiet; at most what it can carry in the time of an answer."""
        self._port.timeout = QUIET
        data = b""
        while len(data) < protocol.BAUD // 10 * ANSWER and (
            more := self._port.read(max(1, self._port.in_waiting))
        ):
            data += more
        return data

    def _count(self, **more: int) -> None:
        self.counts = self.counts._replace(**{key: getattr(self.counts, key) + n for key, n in more.items()})

    @contextmanager
    def _attached(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:  # all of pyserial's errors are
            raise Unplugged(str(error)) from None
