"""Times of the messages of a topic, and what can be wrong with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import numpy as np

from robot.recordings.bags.bag import Bag, Topic
from tactile.base.errors import InputError

Clock = Literal["header", "bag"]
GAP = 10.0  # median steps: a longer pause of at least `LEAST_GAP` s is reported
LEAST_GAP = 1.0
BAG_TIME = "set recording.topics.clock to bag"

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
        stamped = clock == "header" and hasattr(content, "header")
        yield Message(number, nanoseconds(content.header.stamp) if stamped else received, content)


def read_usable(bag: Bag, topic: Topic, clock: Clock, read: Callable[[Any, str], Any]) -> Iterator[Message]:
    """The messages of a topic that can be used, with what `read` makes of them (see `Bag.usable`)."""
    for number, received, content, value in bag.usable(topic, read):
        stamped = clock == "header" and hasattr(content, "header")
        yield Message(number, nanoseconds(content.header.stamp) if stamped else received, value)


def nanoseconds(stamp: Any) -> int:
    """A time message in ns."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def seconds(stamp: int) -> str:
    """ns as text in s, exact."""
    return f"{stamp // 10**9}.{stamp % 10**9:09d}"


def in_seconds(stamps: list[int]) -> np.ndarray:
    """[M] s, each the nearest double."""
    return np.array([stamp / 10**9 for stamp in stamps])


def usable_stamps(
    stamps: list[int], where: str, clock: Clock, report: Report
) -> tuple[np.ndarray, list[InputError]]:
    """The messages to use: [M] bool; those that repeat a stamp are left out and reported, as are gaps.

    Errors: a stamp is 0 or earlier than the one before.
    """
    times = np.array(stamps, np.int64)
    cure = BAG_TIME if clock == "header" else ""
    errors = []
    if (times == 0).any():
        number, count = int((times == 0).argmax()), int((times == 0).sum())
        found = f"the stamp is 0 (in {count} of {len(times)} messages)"
        errors.append(InputError(f"{where}, message {number}", found, "the time of the measurement", cure))
        return times > 0, errors
    steps = np.diff(times)
    if (steps < 0).any():
        number = int((steps < 0).argmax()) + 1
        found = f"the stamp goes back from {seconds(stamps[number - 1])} to {seconds(stamps[number])} s"
        found += f" (so in {int((steps < 0).sum())} of {len(times)} messages)"
        errors.append(InputError(f"{where}, message {number}", found, "times that increase", cure))
        return np.ones(len(times), bool), errors
    fresh = np.concatenate([[True], steps > 0])
    if not fresh.all():
        number, count = int((~fresh).argmax()), int((~fresh).sum())
        repeated = f"{count} of {len(times)} messages repeat the stamp of the message before"
        report(f"{where}: {repeated}, the first at {seconds(stamps[number])} s; they are left out")
    steps = steps[steps > 0]
    if len(steps):
        gaps = (steps > GAP * np.median(steps)) & (steps >= LEAST_GAP * 1e9)
        if gaps.any():
            longest = int(steps.argmax())
            start = int(times[fresh][longest])
            others = f", the longest of {int(gaps.sum())} gaps" if gaps.sum() > 1 else ""
            report(f"{where}: nothing for {steps[longest] / 1e9:.3g} s from {seconds(start)} s on{others}")
    return fresh, errors


class Series(NamedTuple):
    """Values of a topic over time.

    Attributes:
        where: file and topic, for errors. time: [M] s, increasing. values: [M, ...].
        numbers: [M] message of each value. errors: found in it; without any, M is at least 1.
    """

    where: str
    time: np.ndarray
    values: np.ndarray
    numbers: np.ndarray
    errors: list[InputError]

    def place(self, row: int) -> str:
        return f"{self.where}, message {self.numbers[row]}"


def as_series(
    where: str, numbers: list[int], stamps: list[int], values: np.ndarray, clock: Clock, report: Report
) -> Series:
    """The values [M, ...] of messages with usable stamps.

    Raises:
        InputError: there are no values.
    """
    if not stamps:
        raise InputError(where, "no message that can be used", "at least one")
    use, errors = usable_stamps(stamps, where, clock, report)
    return Series(where, in_seconds(stamps)[use], values[use], np.array(numbers)[use], errors)
