"""A session under way: along the route, and whisk by whisk to the journal and to whoever maps."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from robot.drivers.head.cycle_assembly import assembled, cut_of
from robot.drivers.head.decoder import Frames
from robot.drivers.outcome import Fault, Outcome
from robot.drivers.ur10.safety import Refused
from robot.live.rig import TICK, Faulted, Rig
from robot.live.route import Route
from robot.sources.source import Sample
from tactile.base.errors import InputError
from tactile.base.types import Cycle, Odometry
from tactile.whiskers.whisking import MID_PROTRACTION

LONGEST = 120.0
"""How long a way without whisks may take, s."""


class Maps(Protocol):
    """Whoever makes a map of samples, without being waited for."""

    @property
    def alive(self) -> bool:
        """Whether it still does."""
        ...

    @property
    def failure(self) -> str:
        """Why not."""
        ...

    def behind(self) -> float:
        """For how long the oldest sample that it has not done has waited, s."""
        ...

    def offer(self, sample: Sample) -> None:
        """The next sample."""
        ...


class Handed(NamedTuple):
    """A whisk that was handed on.

    Attributes:
        number: of the whisk. lateness: s, from its end to then. seen: whether its image went with it.
        missing: frames that had not come by then.
    """

    number: int
    lateness: float
    seen: bool
    missing: int


class Streak(NamedTuple):
    """Whisks one right after the other, by the head's own clock.

    Attributes:
        number: of its first one. first: sequence of its first frame. device: s, that frame's time.
        start: s of the session. samples: frames of a whisk. period: s.
    """

    number: int
    first: int
    device: float
    start: float
    samples: int
    period: float

    def span(self, number: int) -> tuple[int, int]:
        """Sequences of a whisk's first and last frame."""
        first = self.first + (number - self.number) * self.samples
        return first, first + self.samples - 1

    def since(self, number: float) -> float:
        """s since it began, of a whisk or a moment in one."""
        return (number - self.number) * self.period


def drive(rig: Rig, route: Route, mapper: Maps, tell: Callable[[Handed], None]) -> None:
    """Goes the route, and hands on every whisk; ends with the whisk in which it arrives.

    While the head sends nothing, the arm stands.

    Raises:
        robot.live.rig.Faulted: something ends it early. robot.live.rig.Stopped: the operator does.
    """
    number, most = 0, rig.config.whisks
    arrived = False
    while not arrived and number != most:
        streak, life = next_streak(rig, number), rig.restarts
        while rig.streaming and rig.restarts == life:
            _look(rig, mapper)
            arrived = arrived or _advanced(rig, route)
            handed = _whisk(rig, streak, number, mapper)
            if handed is None:
                time.sleep(TICK)
                continue
            tell(handed)
            number += 1
            if arrived or number == most:
                break
        else:
            hold(rig, route)


def go(rig: Rig, route: Route) -> None:
    """Goes a route without whisking for anybody."""
    rig.until(lambda: _advanced(rig, route), LONGEST, Outcome.NOT_ARRIVED, "the way")


def hold(rig: Rig, route: Route) -> None:
    """Stands until the head is back."""
    rig.arm.halt("the head sends nothing")
    rig.note("held", "the head sends nothing")
    # How long it is waited for is the reader's to say: it makes a fault of it.
    rig.until(lambda: rig.streaming, float("inf"), Outcome.HEAD_GONE, "the head")
    rig.note("resumed", "the head is back")
    route.again()


def next_streak(rig: Rig, number: int) -> Streak:
    """The streak that begins with the next whisk.

    Raises:
        InputError: the head makes no whole number of samples a whisk, or begins no whisk.
    """
    rate = rig.config.plan.whisking.rate
    assert rig.head.identity is not None
    count = rig.head.identity.rate / rate
    if abs(count - round(count)) > 1e-6:
        raise InputError("live.plan.whisking.rate", f"{count:g} samples a whisk", "a whole number of samples")
    rig.look()  # what a head that was away has sent since may be waiting
    known, life = len(rig.starts), rig.restarts

    def begun() -> int | None:
        """The first frame of the first whisk to begin from now on, which may be that of a head found anew."""
        return next(iter(rig.starts[known if rig.restarts == life else 0 :]), None)

    longest = rig.config.head.patience + 2 / rate + 1.0
    rig.until(lambda: begun() is not None, longest, Outcome.HEAD_SILENT, "the beginning of a whisk")
    first = begun()
    assert first is not None
    device = float(rig.head.ring.between(first, first).time[0]) * 1e-6
    start = float(rig.clock.host(device)) - rig.epoch
    return Streak(number, first, device, start, round(count), 1 / rate)


def free_whisks(rig: Rig, count: int) -> list[Cycle]:
    """Whisks in free air, as they are, for the calibration."""
    streak = next_streak(rig, 0)
    record = []
    for number in range(count):
        first, last = streak.span(number)
        rig.until(partial(_complete, rig, last), 3 * streak.period + 1.0, Outcome.HEAD_SILENT, "a whisk")
        frames = rig.head.ring.between(first, last)
        begin = streak.since(number)
        cut = cut_of(number, begin, begin, frames, Odometry(0.0, 0.0, 0.0, 0.0))
        record.append(assembled(frames, cut))
    return record


def _whisk(rig: Rig, streak: Streak, number: int, mapper: Maps) -> Handed | None:
    """Hands on a whisk that is over, complete or waited for long enough; None while it is neither."""
    first, last = streak.span(number)
    due = float(rig.clock.host(streak.device + streak.since(number + 1)))
    now = time.monotonic()
    if not _complete(rig, last) and now < due + rig.config.grace:
        return None
    frames = rig.head.ring.between(first, last)
    start = streak.start + streak.since(number)
    stamp = streak.start + streak.since(number + MID_PROTRACTION)
    odometry, truth = rig.odometer.told(
        stamp, float(rig.clock.host(streak.device + streak.since(number + MID_PROTRACTION)))
    )
    whole, slow = _whole(frames, first, last, rig.config.gap), mapper.behind() > rig.config.budget
    cut = cut_of(number, stamp, start, frames, odometry, seen=whole and not slow)
    if not cut.seen:
        rig.note(
            "dropped", f"whisk {number}: " + ("the mapper is behind" if whole else "samples are missing")
        )
    if rig.journal is not None:
        rig.journal.cut(cut, frames, truth)
    mapper.offer(Sample(stamp, assembled(frames, cut), truth))
    return Handed(number, time.monotonic() - due, cut.seen, streak.samples - len(frames.sequence))


def _advanced(rig: Rig, route: Route) -> bool:
    """Whether the arm has arrived at the end of the route; if at a target, it is sent to the next one."""
    try:
        return route.advance(rig.arm)
    except Refused as error:  # for what ends it anyway, or for the target
        fault = rig.arm.fault or Fault(Outcome.OUT_OF_BOX, str(error), time.monotonic())
        raise Faulted(fault) from error


def _look(rig: Rig, mapper: Maps) -> None:
    rig.look()
    if not mapper.alive:
        raise Faulted(Fault(Outcome.MAPPER_GONE, mapper.failure, time.monotonic()))


def _complete(rig: Rig, last: int) -> bool:
    """Whether that sample has come, or a later one."""
    newest = rig.head.ring.newest
    return newest is not None and newest[0] >= last


def _whole(frames: Frames, first: int, last: int, gap: int) -> bool:
    """Whether fewer than so many samples are missing anywhere on end, and their times are as even."""
    known = np.concatenate([[first - 1], frames.sequence, [last + 1]])
    step = np.diff(frames.time)
    even = len(step) > 0 and step.min() > 0 and step.max() <= gap * np.median(step)
    return bool(np.diff(known).max() <= gap and even)
