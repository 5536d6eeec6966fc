"""Times of the messages of a topic, and messages that cannot be used."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, NamedTuple

import numpy as np

from robot.recordings.bags.bag import Bag, Topic
from robot.recordings.input_judge import GAP, LEAST_GAP
from robot.recordings.sanity_checks import leave_out
from tactile.base.errors import InputError

Clock = Literal["header", "bag"]
OTHER_CLOCK: dict[Clock, Clock] = {"header": "bag", "bag": "header"}

Report = Callable[[str], None]


def stamp_of(content: Any, received: int, clock: Clock) -> int:
    """The time of a message received at this time, ns, by a clock."""
    stamped = clock == "header" and hasattr(content, "header")
    return nanoseconds(content.header.stamp) if stamped else received


def read_usable(
    bag: Bag, topic: Topic, clock: Clock, read: Callable[[Any, str], Any]
) -> Iterator[tuple[int, int, Any]]:
    """Number, time in ns, and what `read` makes of each message that can be used (see `Bag.usable`)."""
    for number, received, content, value in bag.usable(topic, read):
        yield number, stamp_of(content, received, clock), value


def nanoseconds(stamp: Any) -> int:
    """A time message in ns."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def in_seconds(stamps: list[int]) -> np.ndarray:
    """[M] s, each the nearest double."""
    return np.array([stamp / 10**9 for stamp in stamps])


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

    def drop(wrong: np.ndarray, row: int, found: str, expected: str) -> None:
        """Leaves out the messages [M] bool; row: the first that is named."""
        first = InputError(f"{where}, message {row}", found, expected, cure)
        errors.extend(leave_out(int(wrong.sum()), len(times), "messages", first, report))
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
        said = (
            f"{len(repeated)} of {len(times)} messages repeat the stamp of the message before, the first at "
        )
        said += f"{times[repeated[0]] / 1e9:.3f} s; they are left out"
        report(f"{where}: {said}{f'; {cure}' if cure and len(repeated) > len(times) / 2 else ''}")
        use[repeated] = False
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
