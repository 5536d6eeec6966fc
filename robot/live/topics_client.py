"""A connection to the topics of a running robot: what every way to it has in common."""

from __future__ import annotations

import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, NamedTuple

from robot.recordings.bags.bag import Messages, Topic, learn_type
from robot.recordings.bags.topics_config import TopicsConfig
from tactile.base.errors import InputError

LARGEST = 1 << 26
"""Largest message that is accepted, bytes."""
WAITING = 4096
"""Messages that may wait to be taken; then the client reads no further."""
FULL = 0.01
"""Period at which room for more messages is looked for, s."""
KEPT = 256  # moving transforms of a topic that are kept, for the mount of a sensor
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


class LiveMessages(Messages):
    """Decodes the messages of a running robot, and keeps its transforms.

    Args:
        address: of the robot. say: called with one sentence for whatever is doubtful; once for each.

    Attributes:
        counts: messages so far, by topic.
    """

    def __init__(self, address: str, config: TopicsConfig, say: Callable[[str], None]) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.path, self.clock, self.topics, self._say = address, config.clock, {}, say
        self.counts = Counter[str]()
        self._told = set[str]()
        self._stores: dict[str, Any] = {"cdr": get_typestore(Stores.ROS2_HUMBLE)}
        self._kept: dict[str, list[tuple[int, int, Any]]] = {}
        self._definitions: dict[str, str] = {}
        self._moves: dict[str, Any] = {}  # of ROS 1 to ROS 2, as rosbags keeps them

    def warn(self, sentence: str) -> None:
        if sentence not in self._told:
            self._say(sentence)
        self._told.add(sentence)

    def list_topics(self, channels: dict[str, Channel]) -> None:
        """Sets the topics to those that the robot advertises."""
        for channel in channels.values():
            if channel.encoding == "ros1" and "ros1" not in self._stores:
                from rosbags.typesys import Stores, get_typestore

                self._stores["ros1"] = get_typestore(Stores.ROS1_NOETIC)
            told = channel.definition and channel.notation != "ros2idl"
            for store in self._stores.values() if told else ():
                learn_type(store, channel.kind, channel.definition)
        # That messages come is awaited, not asked.
        self.topics = {name: Topic(name, channel.kind, 1) for name, channel in sorted(channels.items())}

    def readable(self, channel: Channel) -> bool:
        """Whether messages of a topic can be decoded."""
        return channel.encoding in self._stores and channel.kind in self._stores["cdr"].fielddefs

    def definition(self, channel: Channel) -> str:
        """The definition of the messages of a topic, as ROS 2 writes it."""
        if channel.kind not in self._definitions:
            text = channel.definition if channel.notation == "ros2msg" else ""
            written = self._stores["cdr"].generate_msgdef(channel.kind, ros_version=2)[0]
            self._definitions[channel.kind] = text or written
        return self._definitions[channel.kind]

    def in_cdr(self, received: Received) -> bytes:
        """A message as ROS 2 encodes it.

        Raises:
            InputError: it cannot be decoded.
        """
        channel = received.channel
        if channel.encoding == "cdr":
            return received.content
        from rosbags.convert.converter import migrate_bytes

        stores = self._stores["ros1"], self._stores["cdr"]
        try:
            kinds = channel.kind, channel.kind
            return bytes(
                migrate_bytes(*stores, *kinds, self._moves, received.content, src_is2=False, dst_is2=True)
            )
        except Exception as error:  # whatever a decoder raises for damaged bytes
            raise self._damage(channel, received.content, error) from error

    def decode(self, channel: Channel, content: bytes) -> Any:
        """The content of a message in CDR.

        Raises:
            InputError: it cannot be decoded.
        """
        try:
            return self._stores["cdr"].deserialize_cdr(content, channel.kind)
        except Exception as error:  # whatever a decoder raises for damaged bytes
            raise self._damage(channel, content, error) from error

    def keep(self, topic: str, time: int, content: Any) -> None:
        """Keeps a message with transforms."""
        kept = self._kept.setdefault(topic, [])
        if topic.endswith("tf_static") or len(kept) < KEPT:
            kept.append((len(kept), time, content))

    def usable(self, topic: Topic, read: Callable[[Any, str], Any]) -> Iterator[tuple[int, int, Any, Any]]:
        for number, received, content in self._kept.get(topic.name, []):
            yield number, received, content, read(content, f"{self.path}, {topic.name}, message {number}")

    def _damage(self, channel: Channel, content: bytes, error: Exception) -> InputError:
        words = " ".join(str(error).split())[:200] or type(error).__name__
        found = f"{len(content)} bytes that cannot be decoded ({words})"
        return InputError(f"{self.path}, {channel.topic}", found, f"a message of type {channel.kind}")


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
