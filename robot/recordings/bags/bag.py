"""A bag: its topics and messages, read with rosbags, and one error for everything that damage can do."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from heapq import merge
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from robot.recordings.bags.expansion import bound_expansion, expand_message
from robot.sources.input_files import missing_error, require_file, unreadable_error
from tactile.base.errors import InputError

SUFFIXES = (".bag", ".db3", ".mcap")
"""Of files that can be bags."""
METADATA = "metadata.yaml"
TRANSFORMS = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
"""Types of /tf, of ROS 2 and 1 and of early ROS 1."""
ZSTD = b"\x28\xb5\x2f\xfd"  # first bytes of a compressed message; CDR begins with 00


class Topic(NamedTuple):
    """A topic of a bag.

    Attributes:
        kind: its message type, such as nav_msgs/msg/Odometry. total: number of messages.
    """

    name: str
    kind: str
    total: int


class Bag:
    """An open bag, a context manager.

    Args:
        path: a `.bag`, `.db3` or `.mcap` file, a ROS 2 folder with metadata.yaml, or a folder with the
            parts of a ROS 1 bag.

    Attributes:
        topics: by name.

    Raises:
        InputError: the bag is missing, damaged or empty, or rosbags is not installed.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._stack = path, ExitStack()
        files = bag_files(path)
        try:
            from rosbags import rosbag1, rosbag2
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise InputError("rosbags", "not installed", "", "pip install 'ratslam[ros]'") from None
        bound_expansion()
        first = files[0].suffix == ".bag"
        with damage_errors(path):
            readers: list[Any] = [rosbag1.Reader(file) for file in files] if first else [rosbag2.Reader(path)]
            for reader in readers:
                reader.open()
                self._stack.callback(reader.close)
            self._store: Any = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
            for kind in TRANSFORMS - self._store.fielddefs.keys():
                self._store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
            self._decode = self._store.deserialize_ros1 if first else self._store.deserialize_cdr
            self._readers, self._first = readers, first
            self.topics = self._list_topics()
        if not sum(topic.total for topic in self.topics.values()):
            self._stack.close()
            raise InputError(str(path), "a bag without messages", "at least one message")

    def _list_topics(self) -> dict[str, Topic]:
        topics = dict[str, Topic]()
        for connection in (each for reader in self._readers for each in reader.connections):
            name, kind = str(connection.topic), str(connection.msgtype)
            known = topics.get(name, Topic(name, kind, 0))
            both = kind if known.kind == kind else f"{known.kind} and {kind}"
            topics[name] = Topic(name, both, known.total + int(connection.msgcount))
        return dict(sorted(topics.items()))

    def topic(self, name: str, key: str) -> Topic:
        """The topic of this name; a leading slash may be missing.

        Args:
            key: configuration key of the name, for errors.

        Raises:
            InputError: there is no such topic, or it has no messages.
        """
        spellings = (name, f"/{name}", name.removeprefix("/"))
        found = next((self.topics[each] for each in spellings if each in self.topics), None)
        if found is None:
            raise missing_error(str(self.path), "topic", name, list(self.topics), key)
        if not found.total:
            raise InputError(f"{self.path}, {found.name}", "no messages", "at least one message")
        return found

    def messages(self, topic: Topic) -> Iterator[tuple[int, Any]]:
        """The messages of a topic in the order in which they were received: time of receipt in ns, content.

        Raises:
            InputError: the bag is damaged, or the topic's type is unknown or defined differently.
        """
        self._check_type(topic)
        with damage_errors(self.path):
            for time, raw in self._raw(topic):
                yield time, self._decode(_plain(raw), topic.kind)

    def receipts(self, topic: Topic) -> Iterator[int]:
        """The times of receipt, ns, of the messages of a topic of any type.

        Raises:
            InputError: the bag is damaged.
        """
        with damage_errors(self.path):
            for time, _ in self._raw(topic):
                yield time

    def _raw(self, topic: Topic) -> Iterator[tuple[int, Any]]:
        parts = []
        for reader in self._readers:
            chosen = [each for each in reader.connections if each.topic == topic.name]
            if chosen:
                parts.append(reader.messages(chosen))
        time = None
        for _, time, raw in merge(*parts, key=lambda entry: entry[1]):
            if not 0 <= time < 1 << 63:
                raise ValueError(f"a message received at {time} ns")
            yield int(time), raw
        if time is None:
            raise ValueError(f"{topic.total} messages of {topic.name} are listed, and none is there")

    def _check_type(self, topic: Topic) -> None:
        where = f"{self.path}, {topic.name}"
        if topic.kind not in self._store.fielddefs:
            raise InputError(where, f"messages of type {topic.kind}", "a type that ROS itself defines")
        if self._first:
            digest = self._store.generate_msgdef(topic.kind)[1]
            connections = (each for reader in self._readers for each in reader.connections)
            if any(each.topic == topic.name and each.digest not in (digest, "*") for each in connections):
                raise InputError(where, f"another definition of {topic.kind}", "that of ROS Noetic")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()


@contextmanager
def damage_errors(path: Path) -> Iterator[None]:
    """Turns whatever a reader of damaged bytes raises into an `InputError`."""
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise unreadable_error(path, error) from error
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        cure = (
            "was it copied and closed completely? try `rosbag reindex`, `ros2 bag reindex` or `mcap recover`"
        )
        raise InputError(str(path), f"cannot be read as a bag: {reason}", "a whole bag", cure) from error


def bag_files(path: Path) -> list[Path]:
    """The files of a bag, for a ROS 2 folder metadata.yaml first.

    Raises:
        InputError: there is no such bag.
    """
    if not path.is_dir():
        require_file(path)
        if path.suffix not in SUFFIXES:
            cure = "name its folder, the one with metadata.yaml" if path.suffix == ".zstd" else ""
            raise InputError(str(path), f"a file {path.suffix!r}", f"a bag: {', '.join(SUFFIXES)}", cure)
        return [path]
    there = sorted(file for file in path.iterdir() if file.is_file())
    if path / METADATA in there:
        stored = [file for file in there if set(file.suffixes) & set(SUFFIXES)]
        return [path / METADATA, *stored]
    bags = [file for file in there if file.suffix == ".bag"]
    if bags:
        return bags
    stored = [file for file in there if file.suffix in SUFFIXES]
    cure = f"`ros2 bag reindex`, or name the file: {stored[0].name}" if stored else ""
    raise InputError(str(path), f"is a folder without {METADATA}", "a file or the folder of a bag", cure)


def bag_digest(path: Path) -> str:
    """SHA-256 (hex) of the files of a bag, one after the other."""
    total = hashlib.sha256()
    for part in bag_files(path):
        try:
            with part.open("rb") as file:
                while content := file.read(1 << 20):
                    total.update(content)
        except OSError as error:
            raise unreadable_error(part, error) from error
    return total.hexdigest()


def _plain(raw: Any) -> bytes:
    """A message, decompressed if its storage file is read without the folder that says so."""
    content = bytes(raw)
    if content[:4] != ZSTD:
        return content
    return expand_message(content)
