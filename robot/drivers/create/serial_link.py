"""Serial link to the Create: a query and its reply over an unreliable line."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from robot.drivers.create import protocol
from robot.drivers.create.protocol import CreateModel, SensorReply
from tactile.base.errors import InputError

ANSWER = 0.1
"""Time-out of a reply, s; a USB adapter delays it by up to 16 ms."""
QUIET = 0.02
"""Time without a byte after which a transmission counts as complete, s."""


class NoPort(InputError):
    """The serial port cannot be opened."""


class PortBusy(NoPort):
    """Another program holds the serial port."""


class Unplugged(Exception):
    """The port was disconnected."""


class NoReply(Exception):
    """No reply."""


class BadReply(Exception):
    """An invalid reply."""


class LinkCounts(NamedTuple):
    """Counts of queries.

    Attributes:
        good: accepted replies. late: of these, after their time-out. lost: timed out, or doubtful because
            noise followed; unless such a reply arrives late, its motion is lost.
            stray: bytes that belonged to no reply.
    """

    good: int = 0
    late: int = 0
    lost: int = 0
    stray: int = 0

    @property
    def outstanding(self) -> int:
        """Lost replies that have not arrived late."""
        return self.lost - self.late


def open_port(name: str, baud: int, *, exclusive: bool = True) -> Any:
    """Opens the serial port, a `serial.Serial`, at the robot's speed, baud.

    Raises:
        NoPort: the port cannot be opened; `PortBusy` if another program holds it.
        InputError: pyserial is not installed.
    """
    try:
        import serial
    except ImportError:
        raise InputError("serial", "pyserial is not installed", "", "pip install 'ratslam[live]'") from None
    # Without `exclusive` pyserial takes no lock; False is refused on Windows.
    more = {"exclusive": True} if exclusive else {}
    try:
        return serial.Serial(name, baud, timeout=ANSWER, write_timeout=ANSWER, **more)
    except OSError as error:
        # The text of pyserial's error is the only place of most causes.
        cause = error.errno or getattr(error.__context__, "errno", None)
        if cause == errno.ENOENT:
            from serial.tools.list_ports import comports

            ports = ", ".join(sorted(port.device for port in comports())) or "none; plug the cable in"
            raise NoPort(name, "no such port", f"one of the ports {ports}") from None
        if cause == errno.EACCES:
            cure = "join its group: sudo usermod -aG dialout $USER"
            raise NoPort(name, "no permission to open it", "", cure) from None
        if cause in (errno.EAGAIN, errno.EBUSY):
            raise PortBusy(name, "is held by another program", "", "end that program") from None
        raise NoPort(name, f"cannot be opened ({error})", "a serial port") from None


def _replies(model: CreateModel, data: bytes, elapsed: float, most: int) -> list[SensorReply]:
    """The bytes as replies, oldest first, at most the last `most`; if invalid, their end as one, or none."""
    size = model.reply.size
    pieces = [model.parse(data[i : i + size], elapsed) for i in range(0, len(data), size)]
    believed = [piece for piece in pieces if piece is not None]
    if len(believed) == len(pieces):
        return believed[-most:]
    last = model.parse(data[-size:], elapsed)
    return [] if last is None else [last]


class SerialLink:
    """Sends queries and reads replies.

    Replies have no identifier, and a reply clears the counters it reports. A late reply is therefore added to
    the next; of a disturbed reply the end is parsed, since noise mostly precedes it.
    """

    def __init__(self, port: Any, model: CreateModel = protocol.MODELS["create1"]) -> None:
        self._port, self._model = port, model
        self._late_motion = (0, 0)
        self.counts = LinkCounts()

    def send(self, command: bytes) -> None:
        """Sends a command."""
        with self._attached():
            self._port.write(command)

    def ask(self, elapsed: float, query: bytes | None = None) -> SensorReply:
        """Sends a query and returns the reply.

        Args:
            elapsed: s since the last reply; inf without one. query: one with a reply of the same layout,
                instead of the model's.

        Raises:
            NoReply, BadReply, Unplugged: no valid reply.
        """
        model = self._model
        with self._attached():
            # Late replies are accepted. Any other bytes make the reply before them doubtful.
            late = self._port.read(self._port.in_waiting) if self._port.in_waiting else b""
            outstanding = self.counts.outstanding
            found = _replies(model, late, elapsed, outstanding) if outstanding else []
            self._accept(found, late=len(found), stray=len(late) - model.reply.size * len(found))
            self._count(lost=int(bool(late) and not found))
            self._port.timeout = ANSWER
            self._port.write(query or model.query)
            data = self._port.read(model.reply.size)
            # Noise and the start of a reply can look like a reply: then more bytes follow.
            if data and (self._port.in_waiting or model.parse(data, elapsed) is None):
                data += self._rest()
        found = _replies(model, data, elapsed, 1 + self.counts.outstanding)
        if not found:
            self._count(lost=1, stray=len(data))
            raise BadReply(f"{len(data)} bytes: {data[:8].hex(' ')}") if data else NoReply("no reply")
        self._accept(found, late=len(found) - 1, stray=len(data) - model.reply.size * len(found))
        (millimetres, degrees), self._late_motion = self._late_motion, (0, 0)
        return found[-1]._replace(millimetres=millimetres, degrees=degrees)

    def close(self) -> None:
        """Closes the port."""
        self._port.close()

    def _accept(self, found: list[SensorReply], *, late: int, stray: int) -> None:
        for reply in found:
            millimetres, degrees = self._late_motion
            self._late_motion = millimetres + reply.millimetres, degrees + reply.degrees
        self._count(good=len(found), late=late, stray=stray)

    def _rest(self) -> bytes:
        """All bytes until the line is quiet, at most those of one time-out."""
        self._port.timeout = QUIET
        data = b""
        while len(data) < self._model.baud // 10 * ANSWER and (
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
        except OSError as error:  # base class of pyserial's errors
            raise Unplugged(str(error)) from None
