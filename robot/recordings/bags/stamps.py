"""Times of the messages of a topic, and messages that cannot be used."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import numpy as np

from robot.recordings.bags.bag import SPOILT, Bag, Topic
from robot.recordings.input_judge import GAP, LEAST_GAP
from tactile.base.errors import InputError

Clock = Literal["header", "bag"]
OTHER_CLOCK: dict[Clock, Clock] = {"header": "bag", "bag": "header"}

Report = Callable[[str], None]


class Message(NamedTuple):
    """A message.

    Attributes:
        number: in the order of receipt, from 0. stamp: ns, by the chosen clock.
    """

    number: int
    stamp: int
    content: Any


def read_messages(bag: Bag, topic: Topic, clock: Clock) -> Iterator[Message]:
    """The messages of a topic with their times."""
    for number, (received, content) in enumerate(bag.messages(topic)):
        yield Message(number, stamp_of(content, received, clock), content)


def stamp_of(content: Any, received: int, clock: Clock) -> int:
    """The time of a message received at this time, ns, by a clock."""
    stamped = clock == "header" and hasattr(content, "header")
    return nanoseconds(content.header.stamp) if stamped else received


def read_usable(bag: Bag, topic: Topic, clock: Clock, read: Callable[[Any, str], Any]) -> Iterator[Message]:
    """The messages of a topic that can be used, with what `read` makes of them (see `Bag.usable`)."""
    for number, received, content, value in bag.usable(topic, read):
        yield Message(number, stamp_of(content, received, clock), value)


def nanoseconds(stamp: Any) -> int:
    """A time message in ns."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def seconds(stamp: int) -> str:
    """ns as text in s, exact."""
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def in_seconds(stamps: list[int]) -> np.ndarray:
    """[M] s, each the nearest double."""
    return np.array([stamp / 10**9 for stamp in stamps])


def left_out(where: str, count: int, total: int, first: InputError, report: Report) -> list[InputError]:
    """Leaves out some messages of a topic: told as a warning, or an error if they are more than `SPOILT`.

    Args:
        count: of the messages left out, of `total`. first: why the first cannot be used.
    """
    if not count:
        return []
    if count > max(1, SPOILT * total):
        found = f"{first.found} (so in {count} of {total} messages)"
        return [InputError(first.where, found, first.expected, first.cure)]
    report(f"{first.where}: {first.found}; {count} of {total} messages are left out")
    return []


def usable_stamps(
    stamps: list[int], where: str, clock: Clock, report: Report, other: list[int] | None = None
) -> tuple[np.ndarray, list[InputError]]:
    """The messages to use: [M] bool. Those that repeat a stamp, a few with stamp 0 and a few out of order are
    left out and reported.

    Args:
        other: times by the other clock, ns; None if they are not known.

    Errors: more stamps than `SPOILT` are 0 or out of order.
    """
    times = np.array(stamps, np.int64)
    worse = clock == "bag" if other is None else bool((np.diff(other) < 0).any())
    cure = "" if worse else other_clock(clock)
    errors, use = list[InputError](), times != 0
    if not use.all():
        number = int((~use).argmax())
        first = InputError(
            f"{where}, message {number}", "the stamp is 0", "the time of the measurement", cure
        )
        errors += left_out(where, int((~use).sum()), len(times), first, report)
    kept = times[use]
    if len(kept) and (np.diff(kept) < 0).any():
        late, early = kept < np.maximum.accumulate(kept), kept > np.minimum.accumulate(kept[::-1])[::-1]
        wrong = early if early.sum() < late.sum() else late
        row = int(late.argmax())
        number = int(np.flatnonzero(use)[row])
        found = f"the stamp goes back from {seconds(int(kept[row - 1]))} to {seconds(int(kept[row]))} s"
        first = InputError(f"{where}, message {number}", found, "times that increase", cure)
        faults = left_out(where, int(wrong.sum()), len(times), first, report)
        errors += faults
        if not faults:
            use[np.flatnonzero(use)[wrong]] = False
    if errors:
        return use, errors
    fresh = np.concatenate([[True], np.diff(times[use]) > 0])
    if not fresh.all():
        number, count = int(np.flatnonzero(use)[~fresh][0]), int((~fresh).sum())
        repeated = f"{count} of {len(times)} messages repeat the stamp of the message before"
        tail = "; they are left out" + (f"; {cure}" if cure and count > len(times) / 2 else "")
        report(f"{where}: {repeated}, the first at {seconds(stamps[number])} s{tail}")
        use[np.flatnonzero(use)[~fresh]] = False
    return use, errors


def other_clock(clock: Clock) -> str:
    """The setting that takes the other times of the messages."""
    return f"--set recording.topics.clock={OTHER_CLOCK[clock]}"


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
    """

    where: str
    time: np.ndarray
    values: np.ndarray
    numbers: np.ndarray
    errors: list[InputError]
    clock: str = ""

    def place(self, row: int) -> str:
        return f"{self.where}, message {self.numbers[row]}"


def as_series(
    where: str,
    numbers: list[int],
    stamps: list[int],
    values: np.ndarray,
    clock: Clock,
    report: Report,
    other: list[int] | None = None,
) -> Series:
    """The values [M, ...] of messages with usable stamps.

    Raises:
        InputError: there are no values.
    """
    if not stamps:
        raise InputError(where, "no message that can be used", "at least one")
    use, errors = usable_stamps(stamps, where, clock, report, other)
    leap = other is not None and leaps(np.array(stamps)[use], np.array(other)[use]).any()
    cure = other_clock(clock) if leap else ""
    return Series(where, in_seconds(stamps)[use], values[use], np.array(numbers)[use], errors, cure)
