"""A connection to the topics of a running robot: what every way to it has in common."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

LARGEST = 1 << 26
"""Largest message that is accepted, bytes."""
WAITING = 4096
"""Messages that may wait to be taken; then the client reads no further."""
FULL = 0.01
"""Period at which room for more messages is looked for, s."""
MOST_TOPICS = 10_000
"""Topics of a robot of which more are ignored."""
CONNECT_TIMEOUT = 5.0
"""Time limit of making a connection, s."""


class Channel(NamedTuple):
    """A topic as it is advertised.

    Attributes:
        number: of the connection's. topic: its name. encoding: of its messages, `cdr` or `ros1`. kind: type
            of its messages, such as nav_msgs/msg/Odometry. definition: of the type, as text; '' where the
            robot does not say it. notation: of the definition: ros2msg, ros2idl or ros1msg.
    """

    number: int
    topic: str
    encoding: str
    kind: str
    definition: str
    notation: str


class Received(NamedTuple):
    """A message. Attributes: time: of its arrival, ns since 1970."""

    channel: Channel
    time: int
    content: bytes


class Notice(NamedTuple):
    """What happened to the connection. Attributes: name: `lost`, `back`, `vanished` or `garbage`. time: ns
    since 1970. topic: that has vanished."""

    name: str
    time: int
    text: str
    topic: str = ""


Wanted = Callable[[Channel], bool]


class TopicsClient:
    """A connection to a robot, made again whenever it is lost.

    Args:
        address: of the robot's side. wanted: whether a topic is to be subscribed to; it may be changed by
            `want`.

    Attributes:
        channels: topics that the robot advertises, by name; the first of several with one name. name: of
            the robot's side. accepts: encodings that it accepts from clients, empty if none may publish.

    Raises:
        InputError: nothing answers at the address, or something else does.
    """

    def __init__(self, address: str, wanted: Wanted) -> None:
        self.address, self._wanted = address, wanted
        self.channels: dict[str, Channel] = {}
        self.name, self.accepts = "", tuple[str, ...]()
        self._taken: queue.SimpleQueue[Received | Notice] = queue.SimpleQueue()
        self._closed = threading.Event()

    def want(self, wanted: Wanted) -> None:
        """Subscribes to other topics, besides those that are subscribed to already."""
        self._wanted = wanted
        self._subscribe()

    def take(self, longest: float) -> list[Received | Notice]:
        """What came since the last call, in its order; waits up to `longest` s for the first."""
        found = list[Received | Notice]()
        with suppress(queue.Empty):
            found.append(self._taken.get(timeout=longest))
            while True:
                found.append(self._taken.get_nowait())
        return found

    def publish(self, topic: str, kind: str, content: bytes) -> None:
        """Sends a message in CDR to a topic; does nothing while there is no connection, or if the robot's
        side does not accept messages."""
        raise NotImplementedError

    def close(self) -> None:
        """Ends the connection."""
        raise NotImplementedError

    def _subscribe(self) -> None:
        """Subscribes to the topics that are wanted."""
        raise NotImplementedError

    def _note(self, name: str, text: str, topic: str = "") -> None:
        self._put(Notice(name, time.time_ns(), text, topic))

    def _put(self, item: Received | Notice) -> None:
        """Hands on what came; waits while there is no room."""
        while self._taken.qsize() >= WAITING and not self._closed.wait(FULL):
            pass
        self._taken.put(item)
