"""A bag of ROS 1 or ROS 2, read with rosbags: its topics, messages and their times.

Whatever damage can do becomes one error. What compressed chunks, messages and files expand to is bounded,
which rosbags does not do. Messages that cannot be used are left out and reported.
"""

from __future__ import annotations

import bz2
import io
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from copy import copy
from functools import cached_property
from heapq import heappop, heappush, merge
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, Literal, NamedTuple, cast

import numpy as np
import zstandard

from robot.recordings.input_judge import GAP, LEAST_GAP
from robot.recordings.mcap_reader import CONVERT, container_fault
from robot.recordings.sanity_checks import WHOLE, Stretch, leave_out
from robot.sources.input_files import missing_error, raise_errors, readable, require_file
from tactile.base.bounded import check_size, expand
from tactile.base.errors import InputError


def _zstd(file: IO[bytes]) -> IO[bytes]:
    return cast(IO[bytes], zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True))


def _expand_message(content: bytes) -> bytes:
    """What a message expands to that is compressed with zstd; an `InputError` if it is too much."""
    return expand(_zstd(io.BytesIO(content)), "a compressed message", len(content))


class _Counted(io.RawIOBase):
    """A decompressed file; an `InputError` where it becomes too large."""

    def __init__(self, file: IO[bytes]) -> None:
        self._stored, self._size = file.seek(0, 2), 0
        file.seek(0)
        self._reader = _zstd(file)

    def read(self, size: int = -1) -> bytes:
        piece = self._reader.read(size)
        self._size += len(piece)
        check_size("a compressed file", self._size, self._stored)
        return piece


def _bound_expansion() -> None:
    """Replaces the decompressors of rosbags by bounded ones."""
    import lz4.frame
    from rosbags.rosbag1 import reader as first
    from rosbags.rosbag2 import reader as second
    from rosbags.rosbag2 import storage_mcap

    openers: dict[str, Any] = {"bz2": bz2.BZ2File, "lz4": lz4.frame.open, "zstd": _zstd}
    for known in (first.decompressors, storage_mcap.DECOMPRESSORS):
        for name in known.keys() & openers.keys():  # a size that is said is not believed
            known[name] = lambda content, *_, opener=openers[name]: expand(
                opener(io.BytesIO(content)), "a compressed chunk", len(content)
            )
    zstd = SimpleNamespace(decompress=_expand_message, open=lambda file, _: _Counted(file))
    second.zstd = cast(Any, zstd)


SUFFIXES = (".bag", ".db3", ".mcap")
"""Of files that can be bags."""
METADATA = "metadata.yaml"
REPAIR = "was it copied and closed completely? try `rosbag reindex`, `ros2 bag reindex` or `mcap recover`"
TRANSFORMS = frozenset({"tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"})
"""Types of /tf, of ROS 2 and 1 and of early ROS 1."""
Clock = Literal["header", "bag"]
OTHER_CLOCK: dict[Clock, Clock] = {"header": "bag", "bag": "header"}
ZSTD = b"\x28\xb5\x2f\xfd"  # first bytes of a compressed message; CDR begins with 00


class Topic(NamedTuple):
    """A topic of a bag. Attributes: kind: its message type, such as nav_msgs/msg/Odometry. total: number of
    messages, as the file or metadata.yaml counts them (the larger one)."""

    name: str
    kind: str
    total: int


class Messages:
    """Messages of topics, as the readers of a part need them: those of a bag, or of a running robot.

    Attributes:
        path: of the bag, or the address of the robot, for errors. topics: by name. clock: which times the
            messages have, where they have a header.
    """

    path: Any
    topics: dict[str, Topic]
    clock: Clock

    def warn(self, sentence: str) -> None:
        """Tells a sentence, once."""
        raise NotImplementedError

    def usable(self, topic: Topic, read: Callable[[Any, str], Any]) -> Iterator[tuple[int, int, Any, Any]]:
        """The messages of a topic that can be used: number, time of receipt in ns, content, and what `read`
        makes of the content and its place."""
        raise NotImplementedError

    def topic(self, name: str, key: str, kinds: Iterable[str] = ()) -> Topic:
        """The topic of this name; a leading slash may be missing.

        Args:
            key: configuration key of the name, for errors. kinds: types that it can have; () for any.

        Raises:
            InputError: there is no such topic, it has no messages, or another type.
        """
        spellings = (name, f"/{name}", name.removeprefix("/"))
        found = next((self.topics[each] for each in spellings if each in self.topics), None)
        if found is None:
            raise missing_error(str(self.path), "topic", name, list(self.topics), key)
        if not found.total:
            raise InputError(f"{self.path}, {found.name}", "no messages", "at least one message")
        if kinds and found.kind not in kinds:
            said = f"messages of type {found.kind}"
            raise InputError(f"{self.path}, {found.name}", said, f"one of {', '.join(kinds)}")
        return found

    def stamp(self, content: Any, received: int, clock: Clock | None = None) -> int:
        """The time of a message received at this time, ns, by a clock; None: that of the settings."""
        stamped = (clock or self.clock) == "header" and hasattr(content, "header")
        return nanoseconds(content.header.stamp) if stamped else received


class Bag(Messages, AbstractContextManager["Bag"]):
    """An open bag, a context manager.

    Args:
        path: a `.bag`, `.db3` or `.mcap` file, a ROS 2 folder with metadata.yaml, or a folder with the
            parts of a ROS 1 bag.
        warn: called with one sentence for whatever is in the bag and is not read; once for each.
        stretch: of the times of receipt; only messages within it are read, besides fixed transforms.
        clock: which times its messages have, where they have a header.

    Attributes:
        topics: by name. other_clock: the setting that takes the other times of the messages.

    Raises:
        InputError: the bag is missing, damaged or empty, or rosbags is not installed.
    """

    def __init__(
        self, path: Path, warn: Callable[[str], None], stretch: Stretch = WHOLE, clock: Clock = "header"
    ) -> None:
        path = path.parent if path.name == METADATA else path
        self.path, self._stack, self._told, self._warn = path, ExitStack(), set[str](), warn
        self._stretch, self.clock = stretch, clock
        self.other_clock = f"--set recording.topics.clock={OTHER_CLOCK[clock]}"
        files = bag_files(path)
        try:
            from rosbags import rosbag1, rosbag2
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise InputError("rosbags", "not installed", "", "pip install 'ratslam[ros]'") from None
        _bound_expansion()
        first = files[0].suffix == ".bag"
        with _damage_errors(path):
            readers: list[Any] = [rosbag1.Reader(file) for file in files] if first else [rosbag2.Reader(path)]
            if files[0].name == METADATA:
                text = files[0].read_text(encoding="utf-8", errors="replace")
                if re.search(r"^\s*storage_identifier:\s*(''|\"\")?\s*$", text, re.MULTILINE):
                    readers = [rosbag2.Reader(file) for file in files[1:]]  # `ros2 bag reindex` left it empty
            for reader in readers:
                reader.open()
                self._stack.callback(reader.close)
            listed = readers
            if not first:
                readers = [part for reader in readers for part in _storages(reader.storage)]
                names = {files[0].name, *(part.path.name for part in readers)}
                if unread := [file.name for file in files if not {file.name, file.stem} & names]:
                    cure = "`ros2 bag reindex` lists it"
                    self.warn(f"{path}: {', '.join(unread)} is not in {METADATA} and is not read; {cure}")
            self._store: Any = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
            for kind in TRANSFORMS - self._store.fielddefs.keys():
                self._store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
            for each in (each for reader in readers for each in reader.connections):
                learn_type(self._store, each.msgtype, each.msgdef.data)
            self._decode = self._store.deserialize_ros1 if first else self._store.deserialize_cdr
            self._readers, self._first = readers, first
            self.topics = self._list_topics([each for reader in listed for each in reader.connections])
        if not sum(topic.total for topic in self.topics.values()):
            self._stack.close()
            raise InputError(str(path), "a bag without messages", "at least one message")

    def warn(self, sentence: str) -> None:
        if sentence not in self._told:
            self._warn(sentence)
        self._told.add(sentence)

    def _list_topics(self, listed: list[Any]) -> dict[str, Topic]:
        """The topics of the files and of metadata.yaml, whichever counts more messages."""
        topics = dict[str, Topic]()
        for connections in ((each for reader in self._readers for each in reader.connections), listed):
            totals = dict[str, int]()
            for connection in connections:
                name, kind = str(connection.topic), str(connection.msgtype)
                known = topics.get(name, Topic(name, kind, 0))
                both = known.kind if kind in known.kind else f"{known.kind} and {kind}"
                totals[name] = totals.get(name, 0) + int(connection.msgcount)
                topics[name] = Topic(name, both, max(known.total, totals[name]))
        return dict(sorted(topics.items()))

    def usable(self, topic: Topic, read: Callable[[Any, str], Any]) -> Iterator[tuple[int, int, Any, Any]]:
        """As for `Messages`. Those that cannot be decoded, or for which `read` raises `InputError`, are left
        out with a warning, if these are few (see `leave_out`).

        Raises:
            InputError: the bag is damaged, the topic's type is unknown or defined differently, or more
                messages cannot be used.
        """
        good, spoilt, first = 0, 0, None
        for number, time, content in self._decoded(topic):
            try:
                if isinstance(content, InputError):
                    raise content
                value = read(content, f"{self.path}, {topic.name}, message {number}")
            except InputError as error:
                at, spoilt = f"{error.where}, at {time / 1e9:.3f} s", spoilt + 1
                first = first or InputError(at, error.found, error.expected, error.cure)
            else:
                good += 1
                yield number, time, content, value
        if first is not None:
            raise_errors(leave_out(spoilt, good + spoilt, "messages", first, self.warn))

    def stamped(self, topic: Topic, read: Callable[[Any, str], Any]) -> Iterator[tuple[int, int, Any]]:
        """Number, time in ns, and what `read` makes of each message that can be used (see `usable`)."""
        for number, received, content, value in self.usable(topic, read):
            yield number, self.stamp(content, received), value

    def _decoded(self, topic: Topic) -> Iterator[tuple[int, int, Any]]:
        """The messages with numbers and times of receipt; an `InputError` instead of one that cannot be
        decoded."""
        self._check_type(topic)
        with _damage_errors(self.path):
            for number, (time, raw) in enumerate(self._raw(topic)):
                everywhere = self._stretch == WHOLE or topic.name.endswith("tf_static")
                if not everywhere and not self._stretch.inside(np.array([time / 1e9]), self._start)[0]:
                    continue
                try:
                    plain = bytes(raw)
                    if plain[:4] == ZSTD:  # of a storage file read without the folder that says so
                        plain = _expand_message(plain)
                    content = self._decode(plain, topic.kind)
                except Exception as error:  # whatever a decoder raises for damaged bytes
                    found = f"{len(raw)} bytes that cannot be decoded ({_reason(error)})"
                    place = f"{self.path}, {topic.name}, message {number}"
                    content = InputError(place, found, f"a message of type {topic.kind}")
                yield number, time, content

    def since_start(self, received: float) -> float:
        """s from the start of the recording to a time of receipt, ns."""
        with _damage_errors(self.path):
            return received / 1e9 - self._start

    @cached_property
    def _start(self) -> float:
        """The first time of receipt, s."""
        return min(next(self._raw(topic))[0] for topic in self.topics.values() if topic.total) / 1e9

    def receipts(self, topic: Topic) -> Iterator[int]:
        """The times of receipt, ns, of the messages of a topic of any type."""
        with _damage_errors(self.path):
            for time, _ in self._raw(topic):
                yield time

    def _raw(self, topic: Topic) -> Iterator[tuple[int, Any]]:
        parts, count, time = [], 0, None
        for reader in self._readers:
            chosen = [each for each in reader.connections if each.topic == topic.name]
            if chosen:
                unindexed = hasattr(reader, "messages_scan") and not reader.chunks
                parts.append(_scanned(reader, chosen) if unindexed else reader.messages(chosen))
        for _, time, raw in merge(*parts, key=lambda entry: entry[1]):
            if not 0 <= time < 1 << 63:
                raise ValueError(f"a message received at {time} ns")
            yield int(time), raw
            count += 1
        if time is None:
            raise ValueError(f"{topic.total} messages of {topic.name} are listed, and none is there")
        if count < topic.total:
            found = f"{count} of {topic.total} messages were read, the last received at {time / 1e9:.3f} s"
            cure = "the others are listed, not there; `mcap recover` or `ros2 bag reindex` counts them anew"
            self.warn(f"{self.path}, {topic.name}: {found}; {cure}")

    def _check_type(self, topic: Topic) -> None:
        where = f"{self.path}, {topic.name}"
        if topic.kind not in self._store.fielddefs:
            expected = "a type that ROS itself defines, or a file with its definition (MCAP)"
            raise InputError(where, f"messages of type {topic.kind}", expected)
        everywhere = [each for reader in self._readers for each in reader.connections]
        connections = [each for each in everywhere if each.topic == topic.name]
        coded = {getattr(each.ext, "serialization_format", "cdr") for each in connections} - {"cdr"}
        if coded:
            raise InputError(where, f"messages encoded as {', '.join(coded)}", "CDR, of ROS 2", CONVERT)
        known = ("*", self._store.generate_msgdef(topic.kind)[1]) if self._first else ()
        if self._first and any(each.digest not in known for each in connections):
            raise InputError(where, f"another definition of {topic.kind}", "that of ROS Noetic")

    def __exit__(self, *error: object) -> None:
        self._stack.close()


@contextmanager
def _damage_errors(path: Path) -> Iterator[None]:
    """Turns whatever a reader of damaged bytes raises into an `InputError`."""
    try:
        with readable(path):
            yield
    except InputError:
        raise
    except Exception as error:
        found, cure = container_fault(path) or (f"cannot be read as a bag: {_reason(error)}", REPAIR)
        raise InputError(str(path), found, "a whole bag", cure) from error


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def bag_files(path: Path) -> list[Path]:
    """The files of a bag, for a ROS 2 folder metadata.yaml first.

    Raises:
        InputError: there is no such bag.
    """
    path = path.parent if path.name == METADATA else path
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


def _storages(reader: Any) -> list[Any]:
    """The storage files of a ROS 2 reader; an index of MCAP that lacks parts is not used."""
    found = list(getattr(reader, "storages", [reader]))
    for part in found:
        if not hasattr(part, "meta_scan"):
            continue
        counted, stated = sum(each.msgcount for each in part.connections), part.statistics.message_count
        typed = all(each.msgtype != "__schemaless__" for each in part.connections)
        if typed and counted == stated and all(chunk.message_index_offsets for chunk in part.chunks):
            continue
        before = part.statistics.channel_message_counts
        part.chunks.clear()
        part.connections.clear()
        part.meta_scan()
        counts = Counter(part.statistics.channel_message_counts) | Counter(before)  # the larger ones
        part.connections = [each._replace(msgcount=counts[each.id]) for each in part.connections]
    return found


def _scanned(reader: Any, chosen: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
    """The messages of an MCAP file without index in the order of their times; read with a file handle of its
    own, so that several topics can be read at a time, and twice, so that few messages wait for their turn."""

    def records() -> Iterator[tuple[Any, int, bytes]]:
        own = copy(reader)
        with reader.path.open("rb") as own.bio:
            yield from own.messages_scan(chosen)

    times, done = sorted(time for _, time, _ in records()), 0
    waiting = list[tuple[int, int, Any, bytes]]()
    for number, (connection, time, raw) in enumerate(records()):
        heappush(waiting, (time, number, connection, raw))
        while waiting and waiting[0][0] == times[done]:
            moment, _, connection, raw = heappop(waiting)
            done += 1
            yield connection, moment, raw


def learn_type(store: Any, kind: str, definition: str) -> None:
    """Adds a message type that a store of rosbags does not know, by its definition in the text of ROS; one
    that is missing, or that rosbags cannot read, is left unknown."""
    from rosbags.typesys import TypesysError, get_types_from_msg

    if kind in store.fielddefs or not definition:
        return
    with suppress(TypesysError, ValueError, KeyError):
        new = get_types_from_msg(definition, kind)
        store.register({name: fields for name, fields in new.items() if name not in store.fielddefs})


def nanoseconds(stamp: Any) -> int:
    """A time message in ns."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def in_seconds(stamps: list[int]) -> np.ndarray:
    """[M] s, each the nearest double."""
    return np.array([stamp / 10**9 for stamp in stamps])


def usable_stamps(
    bag: Bag, stamps: list[int], where: str, other: list[int] | None = None
) -> tuple[np.ndarray, list[InputError]]:
    """The messages to use: [M] bool. Those that repeat a stamp, a few with stamp 0 and a few out of order are
    left out and reported.

    Args:
        other: times by the other clock, ns; None if they are not known.

    Errors: more stamps than `SPOILT` are 0 or out of order.
    """
    times = np.array(stamps, np.int64)
    worse = bag.clock == "bag" if other is None else bool((np.diff(other) < 0).any())
    cure = "" if worse else bag.other_clock
    errors, use = list[InputError](), times != 0

    def drop(wrong: np.ndarray, row: int, found: str, expected: str) -> None:
        """Leaves out the messages [M] bool; row: the first that is named."""
        first = InputError(f"{where}, message {row}", found, expected, cure)
        errors.extend(leave_out(int(wrong.sum()), len(times), "messages", first, bag.warn))
        use[wrong] = False

    drop(~use, int((~use).argmax()), "the stamp is 0", "the time of the measurement")
    kept, rows = times[use], np.flatnonzero(use)
    late, early = kept < np.maximum.accumulate(kept), kept > np.minimum.accumulate(kept[::-1])[::-1]
    if late.any():
        row = int(late.argmax())
        before, now = (f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in kept[row - 1 : row + 1].tolist())
        wrong = np.isin(np.arange(len(times)), rows[early if early.sum() < late.sum() else late])
        drop(wrong, int(rows[row]), f"the stamp goes back from {before} to {now} s", "times that increase")
    if errors:
        return use, errors
    rows = np.flatnonzero(use)
    repeated = rows[np.append(False, np.diff(times[rows]) == 0)]
    if len(repeated):
        said = f"{len(repeated)} of {len(times)} messages repeat the stamp of the message before, the first "
        said += f"at {times[repeated[0]] / 1e9:.3f} s; they are left out"
        bag.warn(f"{where}: {said}{f'; {cure}' if cure and len(repeated) > len(times) / 2 else ''}")
        use[repeated] = False
    return use, errors


def leaps(times: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[M - 1] bool, steps of these times [M] that leap ahead or go back, where another clock does not."""
    step, same = np.diff(times), np.diff(other)
    if not len(step):
        return np.zeros(0, bool)
    long = max(GAP * float(np.median(step)), LEAST_GAP * 1e9)
    return ((step > long) & (same < long) & (same >= 0)) | ((step < 0) & (same >= 0))


class Series(NamedTuple):
    """Values of a topic over time.

    Attributes:
        where: file and topic, for errors. time: [M] s, increasing. values: [M, ...].
        numbers: [M] message of each value. errors: found in it; without any, M is at least 1.
        clock: the setting that takes the other times, where these leap and the others do not; else ''.
        body: of odometry, frame of the robot, '' if the bag does not say. held: whether it was velocities.
        poses: [M, 3] of odometry as recorded; None if there are none.
    """

    where: str
    time: np.ndarray
    values: np.ndarray
    numbers: np.ndarray
    errors: list[InputError]
    clock: str = ""
    body: str = ""
    held: bool = False
    poses: np.ndarray | None = None

    def place(self, row: int) -> str:
        return f"{self.where}, message {self.numbers[row]}"


def as_series(
    bag: Bag,
    where: str,
    numbers: list[int],
    stamps: list[int],
    values: np.ndarray,
    other: list[int] | None = None,
) -> Series:
    """The values [M, ...] of messages with usable stamps.

    Raises:
        InputError: there are no values.
    """
    if not stamps:
        raise InputError(where, "no message that can be used", "at least one")
    use, errors = usable_stamps(bag, stamps, where, other)
    leap = other is not None and leaps(np.array(stamps)[use], np.array(other)[use]).any()
    cure = bag.other_clock if leap else ""
    return Series(where, in_seconds(stamps)[use], values[use], np.array(numbers)[use], errors, cure)
